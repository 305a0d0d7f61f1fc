"""Bad input: each gets a statement of what is wrong and what to do, and no verdict."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.compare.model_comparison import ComparedModel
from cgwm.pipeline.compare.short_horizon_errors import short_errors
from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.diagnose.episodes import _more_episodes
from cgwm.pipeline.diagnose.report.wording import unseen_motion
from cgwm.pipeline.fit import fit
from cgwm.pipeline.geometry.rotation import quat_multiply, quat_to_matrix
from cgwm.pipeline.physics import World
from cgwm.pipeline.segments.input_checks import LIMITS, _travel, check_observability, check_units_and_geometry
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.initial_state import clearance
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import InputDataError
from helpers.diagnosis_data import NOISE, tosses, world_with, write_capture
from scipy.signal import savgol_filter

Episodes = list[tuple[str, dict[str, Track]]]


def changed(episodes: Episodes, change: Callable[[Track], Track]) -> Episodes:
    return [(name, {body: change(track) for body, track in tracks.items()}) for name, tracks in episodes]


def shaped(world: World, factor: float) -> World:
    """The world with a body of another size."""
    body = world.bodies[0]
    return world.with_body(0, centers=factor * body.centers, radii=factor * body.radii)


def test_episodes_that_are_one_motion_prove_nothing() -> None:
    world, rng = world_with("ball"), np.random.default_rng(0)
    one = tosses(world, 3, count=1, duration_s=0.4)[0][1]["ball"]

    def shake(track: Track) -> Track:
        return replace(track, position_m=track.position_m + rng.normal(0, NOISE[0], track.position_m.shape))

    episodes = changed([(f"{k}", {"ball": one}) for k in range(4)], shake)
    with pytest.raises(InputDataError, match="are one motion"):
        check_observability(world, prepare(world, episodes), "here")
    others = tosses(world, 3, count=4, duration_s=0.4)
    check_observability(world, prepare(world, others), "here")


def test_noise_that_hides_everything_is_told() -> None:
    world = world_with("ball")
    episodes = tosses(world, 3, count=4, duration_s=0.3, noise=(0.3, 0.5), height_m=(3.0, 4.0))
    with pytest.raises(InputDataError, match=r"noise of \d+ mm.*could be detected"):
        check_observability(world, prepare(world, episodes), "here")


def test_a_body_that_never_moves_is_told() -> None:
    world, rng = world_with("ball"), np.random.default_rng(0)
    place = np.array([0, 0, 0.04]) + rng.normal(0, 5e-4, (40, 3))
    still = Track(np.arange(40) / 100, place, np.tile([1.0, 0, 0, 0], (40, 1)))
    with pytest.raises(InputDataError, match="nothing moves"):
        check_observability(world, prepare(world, [(f"{k}", {"ball": still}) for k in range(3)]), "here")


def test_a_body_of_another_shape_is_told() -> None:
    world = world_with("cube")
    episodes = tosses(world, 3, count=3, duration_s=1.0)
    check_units_and_geometry(world, episodes, "here")
    with pytest.raises(InputDataError, match="under the ground"):
        check_units_and_geometry(shaped(world, 3.0), episodes, "here")
    small = shaped(world, 0.3)
    with pytest.raises(InputDataError, match="above the ground and does not fall"):
        check_observability(small, prepare(small, episodes), "here")


def test_bounces_that_a_filter_smeared_do_not_float() -> None:
    """At 60 Hz a window of eleven frames lifts a bounce by centimetres, in frames that are no flight."""
    world = world_with("ball")

    def smooth(track: Track) -> Track:
        assert track.quat_wxyz is not None
        quat = savgol_filter(track.quat_wxyz, 11, 2, axis=0)
        quat /= np.linalg.norm(quat, axis=1, keepdims=True)
        return replace(track, position_m=savgol_filter(track.position_m, 11, 2, axis=0), quat_wxyz=quat)

    fallen = tosses(world, 3, count=3, duration_s=0.5, rate_hz=60.0, height_m=(0.3, 0.4), lift_m_s=(0.0, 0.01))
    episodes = changed(fallen, smooth)
    prepared = prepare(world, episodes)
    high = prepared.supported & (clearance(world, prepared.observations) > LIMITS.most_off * 0.04)
    assert float(high.sum()) > LIMITS.most_carried * float(prepared.observations.seen.amax(-1).sum())
    check_observability(world, prepared, "here")


def test_a_ball_that_rolls_up_a_tilted_frame_does_not_float() -> None:
    world, times, rng = world_with("ball"), np.arange(100) / 100, np.random.default_rng(0)
    slope, speed = 0.02, (0.8, 1.0, 1.2)
    quiet = NOISE[0] * rng.standard_normal((3, 100, 3))

    def rolling(v: float, k: int, lift: float) -> Track:
        place = np.stack((v * times, 0.1 * k + 0 * times, 0.04 + lift + slope * v * times), 1) + quiet[k]
        turn = np.stack((np.cos(v * times / 0.08), 0 * times, np.sin(v * times / 0.08), 0 * times), 1)
        return Track(times, place, turn)

    def checked(lift: float) -> None:
        episodes = [(f"{k}", {"ball": rolling(v, k, lift)}) for k, v in enumerate(speed)]
        check_observability(world, prepare(world, episodes), "here")

    checked(0.0)
    with pytest.raises(InputDataError, match="above the ground and does not fall"):
        checked(0.03)


def test_a_tilted_frame_is_no_other_shape() -> None:
    """Three degrees of tilt put a body a quarter of a metre away 13 mm under the ground: that is for the diagnosis."""
    world = world_with("cube")
    episodes = tosses(world, 3, count=4, duration_s=1.0)
    name = world.bodies[0].name
    turn = torch.tensor([math.cos(0.026), 0.0, math.sin(0.026), 0.0], dtype=torch.float64)
    matrix = quat_to_matrix(turn).numpy()

    def seen(track: Track, sideways: float, lower: float) -> Track:
        position = (track.position_m + np.array([sideways, 0, 0])) @ matrix.T - [0, 0, lower]
        quat = quat_multiply(turn, torch.tensor(track.quat_wxyz)).numpy()
        return replace(track, position_m=position, quat_wxyz=quat)

    away = [(n, {name: seen(t[name], 0.2 + 0.1 * k, 0.0)}) for k, (n, t) in enumerate(episodes)]
    assert float(clearance(world, whole_episodes(world, away)).min()) < -0.012
    check_units_and_geometry(world, away, "here")
    lower = [(n, {name: seen(t[name], 0.2 + 0.1 * k, 0.03)}) for k, (n, t) in enumerate(episodes)]
    with pytest.raises(InputDataError, match="under the ground"):
        check_units_and_geometry(world, lower, "here")


def test_a_mass_and_an_inertia_that_no_such_body_has_are_told() -> None:
    world = world_with("cube")
    body, episodes = world.bodies[0], tosses(world, 3, count=3, duration_s=0.3)
    with pytest.raises(InputDataError, match="osmium"):
        check_units_and_geometry(world.with_body(0, mass=1e6 * body.mass, inertia=1e6 * body.inertia), episodes, "here")
    with pytest.raises(InputDataError, match="moments of inertia"):
        check_units_and_geometry(world.with_body(0, inertia=100 * body.inertia), episodes, "here")


def test_a_verdict_says_which_kind_of_motion_it_does_not_cover() -> None:
    """The whole sentence of a diagnosis of throws alone is tested by `make evidence`."""
    flown = SimpleNamespace(contact_items=[], flight=object())
    assert unseen_motion(flown) == " Only flight was measured, so the verdict does not cover contact."
    slid = SimpleNamespace(contact_items=[object()], flight=None)
    assert unseen_motion(slid) == " Only contact was measured, so the verdict does not cover flight."
    assert unseen_motion(SimpleNamespace(contact_items=[object()], flight=object())) == ""


# In the suite: the sentence itself is tested above.
@pytest.mark.evidence
def test_one_kind_of_motion_alone_is_said_in_the_verdict(tmp_path: Path) -> None:
    truth = world_with("ball", {"magnus_lift": {"s": 0.04}})
    model = write_capture(tmp_path / "high", truth, tosses(truth, 3, count=5, duration_s=0.35, height_m=(2.0, 3.0)))
    found = diagnose(model, tmp_path / "high")
    assert found.sentence.endswith("Only flight was measured, so the verdict does not cover contact.")
    assert found.next_motions is not None and found.next_motions.motions  # which does


def test_milliseconds_are_told_before_a_fit_as_well(tmp_path: Path) -> None:
    world = world_with("ball")
    slow = changed(tosses(world, 3, count=4, duration_s=0.3), lambda track: replace(track, time_s=1e3 * track.time_s))
    write_capture(tmp_path / "slow", world, slow)
    with pytest.raises(InputDataError, match="milliseconds"):
        fit(tmp_path / "slow", tmp_path / "model")


def test_a_noise_that_was_given_is_not_talked_down() -> None:
    world = world_with("ball")
    episodes = tosses(world, 3, count=4, duration_s=0.4)
    told = prepare(world, episodes, (10 * NOISE[0], 10 * NOISE[1]))
    assert told.noise == (10 * NOISE[0], 10 * NOISE[1])
    assert any("The given value is used" in warning for warning in told.warnings)
    # what is more than was given is measured
    assert prepare(world, episodes, (0.1 * NOISE[0], None)).noise[0] == pytest.approx(NOISE[0], rel=0.2)


def test_what_was_not_measured_is_no_degree_of_freedom() -> None:
    world = world_with("ball", ground=False)

    def heights_only(track: Track) -> Track:
        return replace(track, position_m=track.position_m * [0.0, 0.0, 1.0], quat_wxyz=None)

    episodes = changed(tosses(world, 3, count=3, duration_s=0.3), heights_only)
    prepared = prepare(world, episodes)
    assert prepared.flight is not None
    assert prepared.flight.dof.tolist() == [len(episodes[0][1]["ball"]) - 2] * 3
    short = short_errors(world, episodes, prepared, ["ball"]).errors["000"]
    assert np.isfinite(short.sigmas[:, 0]).any(0).tolist() == [False, False, True, False, False, False]
    one = ComparedModel(
        name="m", short_name="m", model=None, evaluation=None, noise=prepared.noise, short={"000": short}
    )  # pyright: ignore[reportArgumentType]
    assert one.episode_chi2("000") == pytest.approx(1.0, abs=0.6)


def test_a_ball_whose_bounces_smoothing_lifts_off_the_ground_is_no_other_shape() -> None:
    """Parabolas through 17 frames never come as low as the ball: the bounce itself looks airborne."""
    world = world_with("ball")

    def smoothed(track: Track) -> Track:
        place = savgol_filter(track.position_m, 17, 2, axis=0)
        held = track.time_s < 0.03
        place[held] = place[held][-1]  # a hand
        return replace(track, position_m=place)

    episodes = changed(tosses(world, 5, count=6, duration_s=1.0, rate_hz=148.0, height_m=(0.4, 0.6)), smoothed)
    prepared = prepare(world, episodes)
    check_observability(world, prepared, "here")
    seen = prepared.observations.seen.amax(-1) > 0
    assert 0 < float(prepared.supported.sum()) < 0.2 * float(seen.sum())
    assert prepared.flight is not None
    for item in prepared.flight.items:
        frames = slice(item.first, item.last + 1)
        t = prepared.observations.times_s[item.episode, frames].numpy()
        height = prepared.observations.position_m[item.episode, frames, 0, 2].numpy()
        assert -2 * np.polyfit(t, height, 2)[0] == pytest.approx(9.81, rel=0.5), "an impact passes as flight"


def test_a_flight_under_a_strange_force_is_no_support() -> None:
    """Gravity of a third of the usual one, as of a step of it, is found in parabolas through all heights."""
    light = replace(world_with("ball"), gravity=world_with("ball").gravity / 3)
    world, episodes = world_with("ball"), tosses(light, 3, count=4, duration_s=0.4, height_m=(0.8, 1.0))
    assert not bool(prepare(world, episodes).supported.any())


def test_times_in_another_unit_are_refused_before_anything_else() -> None:
    world = world_with("ball")
    slow = changed(tosses(world, 3, count=2, duration_s=0.3), lambda track: replace(track, time_s=1e3 * track.time_s))
    with pytest.raises(InputDataError, match="time"):
        check_units_and_geometry(world, slow, "capture")


def test_the_largest_moment_of_inertia_has_to_fit_into_the_shape() -> None:
    """A ball of radius r has at most m r^2; the other two moments may be possible."""
    world = world_with("ball")
    body = world.bodies[0]
    most = float(body.mass[0]) * float(body.radii.max()) ** 2
    for share, fits in ((0.9, True), (1.1, False)):
        moments = torch.diag(most * torch.tensor([0.6, 0.7, share], dtype=torch.float64))[None]
        other = world.with_body(0, inertia=moments.to(body.inertia))
        if fits:
            check_units_and_geometry(other, tosses(world, 3, count=1, duration_s=0.3), "capture")
        else:
            with pytest.raises(InputDataError, match="moments of inertia"):
                check_units_and_geometry(other, tosses(world, 3, count=1, duration_s=0.3), "capture")


def test_a_motion_within_the_noise_is_none() -> None:
    """The spread of a coordinate within an episode is compared with a multiple of the noise."""
    times, rng = np.arange(0, 0.4, 0.01), np.random.default_rng(0)
    episodes = [(str(k), {"ball": Track(times, rng.normal(0, 0.01, (40, 3)), None)}) for k in range(3)]
    world = world_with("ball", ground=False)
    whole = Observations.of(world, episodes, [(-np.inf, np.inf)] * 3)
    spread = _travel(whole)

    def checked(sigma: float) -> None:
        noise = Noise(sigma, 0.1)
        prepared = SimpleNamespace(observations=whole, noise=noise, least_force_m_s2=0.0)
        check_observability(world, prepared, "here")

    with pytest.raises(InputDataError, match="nothing moves by more than"):
        checked(spread / (0.8 * LIMITS.alike_sigmas))
    checked(spread / (1.5 * LIMITS.alike_sigmas))


def test_too_few_episodes_of_a_split_name_those_of_others() -> None:
    splits = {"train": ("a", "b"), "test": ("c",)}
    capture = SimpleNamespace(manifest=SimpleNamespace(splits=splits))
    assert _more_episodes(capture, "train").startswith("move some of c into 'train' of [splits] in capture.toml, or")  # pyright: ignore[reportArgumentType]
    splits.pop("test")
    assert _more_episodes(capture, "train").startswith("record more")  # pyright: ignore[reportArgumentType]
