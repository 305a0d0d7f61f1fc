"""Throws that begin in a hand are seen by how they turn, told by name, and count from their release on."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.phys_geo.effects import requested_effects
from cgwm.pipeline.phys_geo.tracks.contact_result import PhysicsFit
from cgwm.pipeline.physics import World
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.release_detection import _rotation_chi2, after_release, find_releases
from cgwm.pipeline.trajectories.segmentation import cut_episodes, whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with
from helpers.worlds import F64

NOISE = Noise(2e-5, 4e-4)
HELD_FRAMES = 8
HAND_RAD_S2 = 40.0


def thrown(world: World, seed: int = 3, count: int = 6) -> list[tuple[str, dict[str, Track]]]:
    return tosses(world, seed, count, 0.3, 148.0, NOISE, (0.3, 0.5))


def held(episode: tuple[str, dict[str, Track]]) -> tuple[str, dict[str, Track]]:
    """The toss with a hand that turns the body by `HAND_RAD_S2` until the release."""
    name, tracks = episode
    ((body, track),) = tracks.items()
    assert track.quat_wxyz is not None
    before = np.clip(track.time_s[HELD_FRAMES] - track.time_s, 0, None)
    turn = torch.as_tensor(0.5 * HAND_RAD_S2 * before[:, None] ** 2 * np.array([[0.0, 0.6, 0.8]]))
    quat = quat_multiply(torch.as_tensor(track.quat_wxyz), quat_exp(turn)).numpy()
    return name, {body: replace(track, quat_wxyz=quat)}


def test_a_throw_that_begins_in_a_hand_is_named_and_left_out() -> None:
    world = world_with("cube")
    episodes = thrown(world)
    episodes[2] = held(episodes[2])
    prepared = prepare(world, episodes, NOISE)
    assert list(prepared.released_s) == ["002"]
    # the last frames before the release deviate by less than the noise
    at = round(prepared.released_s["002"] * 148.0)
    assert HELD_FRAMES - 4 <= at <= HELD_FRAMES
    assert any("episode '002' begins in a hand" in text for text in prepared.warnings)
    assert prepared.flight is not None and not bool(prepared.observations.seen[2, :at].any())
    firsts = {item.episode: item.first for item in reversed(prepared.flight.items)}
    assert firsts == {k: at if k == 2 else 0 for k in range(6)}


@pytest.mark.parametrize(
    "effects",
    [
        {"quadratic_drag": {"k": 0.3}},
        *(pytest.param(e, marks=pytest.mark.evidence) for e in ({}, {"spin_damping": {"d": 0.4}})),
    ],
)
def test_what_acts_all_along_the_flight_is_no_hand(effects: Mapping[str, Mapping[str, float]]) -> None:
    for seed in range(4):
        episodes = thrown(world_with("cube", effects), seed)
        assert find_releases(world_with("cube"), episodes, (None, None)) == ({}, [])


def test_an_inertia_that_is_wrong_is_no_hand() -> None:
    world = world_with("cube")
    wrong = torch.diag(torch.tensor([0.6, 1.0, 1.5], dtype=F64)) @ world.bodies[0].inertia
    other = replace(world, bodies=(replace(world.bodies[0], inertia=wrong),))
    assert not find_releases(other, thrown(world), NOISE)[0]


def test_a_fit_leaves_the_hand_out_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    world, given = world_with("cube"), {}

    def physics(_: World, episodes: list[tuple[str, dict[str, Track]]], *__: Any) -> Any:
        given.update(episodes)
        return PhysicsFit(
            contact=None, parameters=(), ground_offset_m=None, noise=NOISE, record={}, warnings=("its own",)
        )  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(requested_effects, "fit_physics", physics)
    episodes = thrown(world)
    episodes[0] = held(episodes[0])
    found = requested_effects.fit_with_effects(world, episodes, None, NOISE)  # pyright: ignore[reportArgumentType]
    assert found.warnings[0] == "its own" and "episode '000' begins in a hand" in found.warnings[1]
    lengths = [len(next(iter(tracks.values()))) for tracks in given.values()]
    assert lengths[0] < lengths[1] == lengths[5] == len(next(iter(episodes[1][1].values())))
    assert after_release(episodes, {})[0][1].keys() == episodes[0][1].keys()


def test_frames_that_were_not_measured_shorten_no_episode() -> None:
    world = world_with("cube")
    whole = whole_episodes(world, thrown(world, count=2))
    seen = whole.seen.clone()
    seen[0, :5] = 0.0
    flight, _, clear = cut_episodes(world, replace(whole, seen=seen), NOISE)
    plain, _, every = cut_episodes(world, whole, NOISE)
    assert min(item.first for item in flight if item.episode == 0) == 5
    assert [item.last for item in flight] == [item.last for item in plain]
    assert bool((clear[0, 5:] == every[0, 5:]).all())


def test_a_hand_hides_neither_another_one_nor_a_wrong_frame() -> None:
    world = world_with("cube")
    episodes = thrown(world)
    episodes[2] = held(episodes[2])
    ((body, track),) = episodes[4][1].items()
    assert track.quat_wxyz is not None
    turn = torch.zeros(len(track), 3, dtype=F64)
    turn[20] = 10 * NOISE[1]
    wrong = quat_multiply(torch.as_tensor(track.quat_wxyz), quat_exp(turn)).numpy()
    episodes[4] = ("004", {body: replace(track, quat_wxyz=wrong)})
    prepared = prepare(world, episodes)
    assert list(prepared.released_s) == ["002"] and prepared.outliers == 1
    assert not bool(prepared.observations.has_orientation[4, 20]) and bool(prepared.observations.has_orientation[4, 19])
    assert np.allclose(prepared.noise, NOISE, rtol=0.15)


def test_rotations_of_flights_have_a_reduced_chi_square_of_one() -> None:
    world = world_with("cube")
    prepared = prepare(world, thrown(world), NOISE)
    assert prepared.flight is not None
    found = _rotation_chi2(prepared.flight)
    assert len(found) == 6 and 0.8 < float(found.mean()) < 1.25


def test_an_unknown_turn_of_a_ball_ends_no_flight() -> None:
    """The lowest point of a ball lies under its centre however it turns; that of a cube does not."""
    unknown = Noise(NOISE.position_m, 0.1)
    for thing, same in (("ball", True), ("cube", False)):
        world = world_with(thing)
        whole = whole_episodes(world, thrown(world, count=2))
        known, turned = (cut_episodes(world, whole, noise)[2] for noise in (NOISE, unknown))
        assert bool((known == turned).all()) == same
        assert not bool((turned & ~known).any())
