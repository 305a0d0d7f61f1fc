"""A lift by a spin that differs from throw to throw and was not measured is named, and no other force of each throw."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.diagnose.flight.own_spin import with_own_spins
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
LIFT, NOISE = 0.1, Noise(2e-4, 1e-2)
Push = Callable[[np.random.Generator, Array, Array], Array]


def throws(lift: float, push: Push | None = None) -> tuple[list[Episode], list[Array]]:
    """Return flights of a ball of which the centre alone is known, pushed aside, and lift times spin of each."""
    rng, episodes, lifts = np.random.default_rng(5), [], []
    hidden = {"magnus_lift": {"s": lift}} if lift else None
    for name, tracks in tosses(world_with("ball", hidden), 3, 8, 0.4, 60.0, (2e-4, 1e-6), (1.5, 2.0)):
        track = tracks["ball"]
        turned = Rotation.from_quat(track.quat_wxyz, scalar_first=True)
        lifts.append(lift * 60.0 * (turned[1:] * turned[:-1].inv()).as_rotvec().mean(0))
        moved = track.position_m if push is None else track.position_m + push(rng, track.time_s, track.position_m)
        episodes.append(Episode(name, {"ball": replace(track, position_m=moved, quat_wxyz=None)}))
    return episodes, lifts


def own_lifts(episodes: list[Episode], library: tuple[str, ...] = ("linear_drag", "spin_lift")) -> dict[str, Array]:
    """Return the lifts that each episode is found to have; empty where none is selected."""
    world = world_with("ball")
    prepared = prepare(world, episodes, NOISE)
    assert prepared.flight is not None
    steps, found, _ = with_own_spins(
        prepared, [], world, prepared.flight, [Candidate(n, load_effect(n)) for n in library]
    )
    if not steps:
        return {}
    assert [step.best.candidate.spec for step in steps] == ["spin_lift@episode"]
    return {
        name: np.array([values[f"spin_lift.q_{axis}"] for axis in "xyz"]) for name, values in found.own_values.items()
    }


def test_each_throw_has_the_lift_of_its_spin() -> None:
    episodes, lifts = throws(LIFT)
    found = own_lifts(episodes)
    assert len(found) == len(episodes)
    away = np.array([found[episode.name] for episode in episodes]) - lifts
    assert np.sqrt(np.mean(away**2)) < 0.1 * np.sqrt(np.mean(np.square(lifts)))


def test_a_lift_is_no_candidate_of_its_own_where_others_are_asked_for() -> None:
    assert not own_lifts(throws(LIFT)[0], ("linear_drag",))


def gust(rng: np.random.Generator, time_s: Array, _: Array) -> Array:
    """Return how far a push of each throw's own from 0.2 s on moves a ball."""
    return 0.5 * np.clip(time_s - 0.2, 0.0, None)[:, None] ** 2 * rng.standard_normal(3)


def tilt(rng: np.random.Generator, time_s: Array, _: Array) -> Array:
    """Return how far a constant push of each throw's own moves a ball."""
    return 0.5 * time_s[:, None] ** 2 * 0.3 * rng.standard_normal(3)


def vortex(_: np.random.Generator, time_s: Array, position_m: Array) -> Array:
    """Return how far a force moves a ball that grows across its way from where it was thrown."""
    way = position_m - position_m[0]
    return 4.0 * (time_s**2)[:, None] / 6 * np.stack([-way[:, 1], way[:, 0], 0 * time_s], 1)


@pytest.mark.parametrize("push", [gust, tilt, vortex])
def test_another_force_of_each_throw_is_no_lift(push: Push) -> None:
    assert not own_lifts(throws(0.0, push)[0])
