"""Motions to record next for contact: how they begin, what they show, and when none is asked for."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.diagnose.next_experiment.contact_information import Channel, contact_information
from cgwm.pipeline.diagnose.next_experiment.hand_motions import HandMotion, face_down, hand_motions, start_states
from cgwm.pipeline.diagnose.next_experiment.motions import Question, best_motions, of_pyramid
from cgwm.pipeline.geometry.rotation import quat_to_matrix
from cgwm.pipeline.physics import State, World
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.segments.candidates import Candidate, variants_of
from cgwm.pipeline.segments.prepare import Prepared, prepare
from cgwm.pipeline.segments.sliding.fit import StartedSliding, better_starts, fit_sliding
from cgwm.pipeline.segments.sliding.separate_starts import separate_starts
from helpers.diagnosis_data import NOISE, world_with
from helpers.worlds import box_body, law, world_of

ORIGIN = torch.zeros(3, dtype=torch.float64)


def at_rest() -> State:
    zero = torch.zeros(1, 1, 3, dtype=torch.float64)
    return State(zero, torch.tensor([[[1.0, 0, 0, 0]]], dtype=torch.float64), zero, zero)


def made(world: World, motions: Sequence[HandMotion], noise: float = 1.0) -> Prepared:
    """Motions of a world, measured with noise at 100 Hz."""
    rng = np.random.default_rng(5)
    times = torch.arange(61, dtype=torch.float64) / 100
    with torch.no_grad():
        motion = measure(world, start_states(world, 0, motions, ORIGIN, at_rest()), times)
    position = motion.position_m[:, :, 0].numpy()
    position = position + noise * NOISE[0] * rng.standard_normal(position.shape)
    name = world.bodies[0].name
    quat = motion.quat_wxyz[:, :, 0].numpy()
    episodes = [Episode(f"{k}", {name: Track(times.numpy(), position[k], quat[k])}) for k in range(len(motions))]
    return prepare(world, episodes, NOISE)


def test_a_body_lies_on_its_largest_stable_face() -> None:
    world = world_of(box_body((0.02, 0.05, 0.04)), contact=law(0.3, 0.004, 0.4))
    turn, name = face_down(world, 0)
    assert name in ("-x", "+x")
    state = start_states(world, 0, [HandMotion(manner="slide", speed_m_s=1.0, heading_deg=90.0)], ORIGIN, at_rest())
    body = world.bodies[0]
    heights = (body.centers[0] @ quat_to_matrix(turn).T)[:, 2] + state.position_m[0, 0, 2] - body.radii[0]
    assert heights.min() == pytest.approx(0.0, abs=1e-12)
    assert (heights < 1e-9).sum() == 4
    assert state.velocity_m_s[0, 0].tolist() == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize("ball", [True, False])
def test_slides_along_and_between_two_axes_tell_a_friction_pyramid(ball: bool) -> None:
    motions = hand_motions(ball)
    chosen = [motions[k] for k in of_pyramid(motions)]
    assert [one.heading_deg for one in chosen] == [0.0, 90.0, 45.0]
    assert {(one.speed_m_s, one.aside_m) for one in chosen} == {(2.5 if ball else 2.0, 0.0)}


def test_a_ball_that_rolls_does_not_slip_and_a_push_slips_more_than_it_moves() -> None:
    world = world_with("ball")
    motions = [HandMotion(manner="roll", speed_m_s=0.5), HandMotion(manner="push", speed_m_s=0.5, spin_rad_s=20.0)]
    state = start_states(world, 0, motions, ORIGIN, at_rest())
    down = torch.tensor([0.0, 0.0, -0.04], dtype=torch.float64)
    slip = state.velocity_m_s[:, 0] + torch.linalg.cross(state.omega_body_rad_s[:, 0], down.expand(2, 3))
    assert slip[0].norm() == pytest.approx(0.0, abs=1e-12)
    assert slip[1].tolist() == pytest.approx([0.5 + 20.0 * 0.04, 0.0, 0.0])
    assert motions[1].what("").startswith("throw it flat along the ground at 0.5 m/s towards +x, with backspin")


def test_the_motion_asked_for_shows_viscous_friction_better_than_most() -> None:
    world = world_with("cube")
    data = made(world, [HandMotion(manner="slide", speed_m_s=0.8), HandMotion(manner="slide", speed_m_s=0.9)])
    effects = [Candidate(name, load_effect(name)) for name in ("viscous_friction", "anisotropic_friction")]
    variants = variants_of(effects, world.gravity[0, :1])
    motions = hand_motions(round_body=False)
    started = StartedSliding.of(data, world, data.flight)
    assert started is not None
    channels, _ = contact_information(data, world, started, variants, motions)
    (sliding,) = [channel for channel in channels if channel.name == "sliding"]
    sizes = np.array([0.1])
    shown = sliding.noncentrality(sliding.reduced(sliding.data + sliding.motions), sizes, 0)
    question = Question(
        variants=tuple(variants),
        names=("viscous_friction", "anisotropic_friction"),
        sizes=(sizes, np.full(2, 0.05)),
        channels=tuple(channels),
        rivals=frozenset({"viscous_friction"}),
    )
    first = best_motions(question, len(motions))[0]
    assert shown[first] > 2 * np.median(shown)
    assert motions[first].speed_m_s == max(motion.speed_m_s for motion in motions)
    # slides along one direction cannot tell a friction by direction from a friction
    aside = sliding.noncentrality(sliding.reduced(sliding.data + sliding.motions), np.full(2, 0.05), 1)
    headings = np.array([motion.heading_deg for motion in motions])
    slides = np.array([motion.manner == "slide" and motion.speed_m_s == 2.0 for motion in motions])
    assert aside[slides & (headings % 180 == 90)].min() > aside[slides & (headings % 180 == 0)].max()


def test_of_the_rivals_of_an_effect_the_one_that_imitates_it_best_counts() -> None:
    rows = np.random.default_rng(3).normal(size=(4, 12, 6))
    motions = rows.transpose(0, 2, 1) @ rows
    columns = ((1,), (2,), (3, 4), (5,))
    channel = Channel(
        name="sliding", base=1, columns=columns, prior=np.array([2.0]), data=motions[0], motions=motions, count=9,
        episodes=motions[:0],
    )  # fmt: skip

    def fall(one: np.ndarray, others: list[int]) -> float:
        inner = one[np.ix_(others, others)] + np.diag([2.0, *np.zeros(len(others) - 1)])
        return 0.25 * float(one[1, 1] - one[1, others] @ np.linalg.solve(inner, one[others, 1]))

    alone = channel.noncentrality(channel.reduced(motions), np.array([0.5]), 0)
    assert alone == pytest.approx([fall(one, [0]) for one in motions], rel=1e-6)
    beside = channel.noncentrality(channel.reduced(motions), np.array([0.5]), 0, [1, 2, 3])
    assert beside == pytest.approx([min(fall(one, [0, *columns[k]]) for k in (1, 2, 3)) for one in motions], rel=1e-6)
    assert np.isinf(channel.noncentrality(channel.reduced(motions), np.array([0.5]), 0, [])).all()


@pytest.mark.parametrize(("known", "asked"), [(1e9, 0), (0.0, 3)])
def test_nothing_is_asked_for_where_everything_is_bounded(known: float, asked: int) -> None:
    world = world_with("cube")
    names = ("viscous_friction", "torsional_friction")
    variants = variants_of([Candidate(name, load_effect(name)) for name in names], world.gravity[0, :1])
    channel = Channel(
        name="sliding",
        base=1,
        columns=((1,), (2,)),
        prior=np.ones(1),
        data=2 * known * np.eye(3),
        episodes=np.stack([known * np.eye(3)] * 2),
        motions=np.stack([np.diag([1e4, 5e3, 1.0]), np.diag([1e4, 1.0, 5e3]), np.diag([1.0, 1.0, 1.0])]),
        count=100,
    )
    question = Question(variants=tuple(variants), names=names, sizes=(np.array([0.2]),) * 2, channels=(channel,))
    chosen = best_motions(question, 3)
    assert len(chosen) == asked
    assert set(chosen) == ({0, 1} if asked else set())


# In the suite: the next test fits two frictions.
@pytest.mark.evidence
@pytest.mark.parametrize(("leading", "first"), [("", 0), ("torsional_friction", 1)])
def test_what_the_data_suggest_is_asked_for_first(leading: str, first: int) -> None:
    names = ("viscous_friction", "torsional_friction")
    variants = variants_of([Candidate(name, load_effect(name)) for name in names], torch.tensor([[0.0, 0.0, -9.81]]))
    channel = Channel(
        name="sliding",
        base=1,
        columns=((1,), (2,)),
        prior=np.ones(1),
        data=np.zeros((3, 3)),
        episodes=np.zeros((2, 3, 3)),
        motions=np.stack([np.diag([1e4, 1e4, 1.0]), np.diag([1e4, 1.0, 6e3])]),
        count=100,
    )
    question = Question(
        variants=tuple(variants),
        names=names,
        sizes=(np.array([0.2]),) * 2,
        channels=(channel,),
        leading=leading,
    )
    assert best_motions(question, 2)[0] == first


def test_a_friction_that_grows_with_the_speed_is_fitted_beside_a_constant_one() -> None:
    """The two cancel each other: joint steps from a viscosity of 0 stalled at a hundredth of it."""
    truth, world = world_with("ball", {"viscous_friction": {"c_v": 1.5}}), world_with("ball")
    speeds, headings = (2.5, 1.5, 2.5), (45, 200, 120)
    pushes = [
        HandMotion(manner="push", speed_m_s=v, spin_rad_s=30.0, heading_deg=h)
        for v, h in zip(speeds, headings, strict=True)
    ]
    data = made(truth, pushes)
    started = StartedSliding.of(data, world, data.flight)
    assert started is not None
    variants = variants_of([Candidate("viscous_friction", load_effect("viscous_friction"))], world.gravity[0, :1])
    soft, known = started.segments.world, started.flight_parameters
    fits = fit_sliding(soft, variants, [(started.base.segments, started.base.values[0])], known, 3)
    for _ in range(3):
        fits = fit_sliding(soft, variants, better_starts(soft, variants, fits, known), known)
    assert float(fits[0].values[0, -1]) == pytest.approx(1.5, rel=0.1)
    assert fits[0].cost < float(started.segments.dof.sum())


def test_two_frictions_are_fitted_from_fits_of_each_slide() -> None:
    """No common friction is near either: a spin that is wrong by turns shows the descent the wrong way."""
    truth, world = world_with("ball", {"anisotropic_friction": {"a": 0.12, "b": 0.0}}), world_with("ball")
    pushes = [HandMotion(manner="push", speed_m_s=2.5, spin_rad_s=30.0, heading_deg=h) for h in (0, 90)]
    data = made(truth, pushes)
    started = StartedSliding.of(data, world, data.flight)
    assert started is not None
    degrees = float(started.segments.dof.sum())
    assert started.base.cost > 100 * degrees
    variants = variants_of([Candidate("anisotropic_friction", load_effect("anisotropic_friction"))], world.gravity[0])
    [(_, values, cost)] = separate_starts(started, variants)
    assert cost < 0.05 * started.base.cost
    assert values[-2] == pytest.approx(0.12, abs=0.03)
