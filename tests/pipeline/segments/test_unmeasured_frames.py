"""What stands in frames that were not measured does not matter, and neither do the other episodes of a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.carried_starts import _beginnings, carried_starts
from cgwm.pipeline.segments.contact_phases import phases_of
from cgwm.pipeline.segments.described_motion import _Predicted
from cgwm.pipeline.segments.impacts.bounces import bounces_of
from cgwm.pipeline.segments.input_checks import _apart, _travel, _turns
from cgwm.pipeline.segments.sliding.segments import find_sliding_segments
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.segmentation import (
    Segment,
    clear_frames,
    cut_episodes,
    supported_frames,
    whole_episodes,
)
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import NOISE, tosses, world_with

HELD = Noise(*NOISE)


@cache
def measured(kind: str) -> tuple[World, Observations]:
    """Tosses of which every fifth frame and the first ones of an episode are hidden, and all of another one."""
    world = world_with("cube" if kind == "cube" else "ball", ground=kind != "flying")
    low = {"height_m": (0.041, 0.042), "lift_m_s": (-0.1, 0.0)} if kind == "low" else {}
    whole = whole_episodes(world, tosses(world, 5, count=4, duration_s=0.6, **low))
    shown = torch.ones_like(whole.seen)
    shown[0, 3::5], shown[1, :4], shown[3], shown[0, -3:] = 0, 0, 0, 0
    return world, replace(whole, seen=whole.seen * shown, has_orientation=whole.has_orientation * shown)


def with_anything_unseen(whole: Observations, seed: int) -> Observations:
    rng = np.random.default_rng(seed)
    place, quat = rng.normal(0, 30.0, whole.position_m.shape), rng.normal(size=whole.quat_wxyz.shape)
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return replace(
        whole,
        position_m=torch.where(whole.seen[..., None] > 0, whole.position_m, torch.as_tensor(place)),
        quat_wxyz=torch.where(whole.has_orientation[..., None] > 0, whole.quat_wxyz, torch.as_tensor(quat)),
    )


def bounces(world: World, whole: Observations) -> list[Any]:
    return [
        (one.episode, *(getattr(side, name).tolist() for side in (one.before, one.after) for name in vars(side)))
        for one in bounces_of(world, whole)
    ]


def beginnings(world: World, whole: Observations) -> list[Any]:
    return [
        (one.episode, one.frames.tolist(), one.times_s.tolist(), one.places_m.tolist(), one.airborne)
        for one in _beginnings(world, whole, HELD)
    ]


def sliding(world: World, whole: Observations) -> list[Segment]:
    return find_sliding_segments(world, whole, clear_frames(world, whole, HELD), HELD)


def phases(_: World, whole: Observations) -> list[Any]:
    airborne = torch.zeros(whole.times_s.shape, dtype=torch.bool)
    return [one.time_s.tolist() for one in phases_of(list("abcd"), whole, airborne, None)]


def supported(world: World, whole: Observations) -> list[Any]:
    items, *_ = cut_episodes(world, whole, HELD)
    return (supported_frames(world, whole, items, HELD) & (whole.seen[..., 0] > 0)).tolist()


CASES: list[tuple[str, Callable[[World, Observations], Any]]] = [
    ("ball", bounces),
    ("flying", beginnings),
    ("low", sliding),
    ("flying", lambda world, whole: carried_starts(world, whole, HELD)),
    ("cube", phases),
    ("cube", supported),
    ("cube", lambda _, whole: (round(_travel(whole), 9), _turns(whole, 0.01), round(_apart(whole), 9))),
]


@pytest.mark.parametrize(("kind", "asked"), CASES)
def test_what_stands_in_frames_that_were_not_measured_does_not_matter(
    kind: str, asked: Callable[[World, Observations], Any]
) -> None:
    world, whole = measured(kind)
    expected = asked(world, whole)
    assert expected is not None
    for seed in (0, 1):
        assert asked(world, with_anything_unseen(whole, seed)) == expected


@pytest.mark.parametrize(("kind", "asked"), CASES[:3])
def test_an_episode_is_judged_as_if_it_were_alone(kind: str, asked: Callable[[World, Observations], Any]) -> None:
    world, whole = measured(kind)

    def named(found: Any, episode: int) -> Any:
        return replace(found, episode=episode) if isinstance(found, Segment) else (episode, *found[1:])

    alone = [named(one, k) for k in range(3) for one in asked(world, whole.select([k]))]
    assert asked(world, whole) == alone != []


def test_errors_of_a_prediction_are_those_of_measured_frames_after_the_warm_up() -> None:
    world = world_with("ball")
    episodes = tosses(world, 5, count=2, duration_s=0.3)
    name, tracks = episodes[0]
    track = tracks["ball"]
    kept = np.delete(np.arange(len(track.time_s)), [14, 15, 20])
    quat = track.quat_wxyz
    assert quat is not None
    cut = replace(track, time_s=track.time_s[kept], position_m=track.position_m[kept], quat_wxyz=quat[kept])
    found = _Predicted.of(world, [(name, {"ball": cut}), episodes[1]], HELD)
    frames = torch.arange(found.after.shape[1])
    for k, count in enumerate((len(kept), len(track.time_s))):
        wanted = (frames > found.last[k]) & (frames < count) & (found.seen.seen[k, :, 0] > 0)
        assert found.after[k, :, 0].equal(wanted) and int(wanted.sum()) == count - int(found.last[k]) - 1
        # the warm-up is a tenth of a second, and both motions begin where it does
        assert float(found.seen.times_s[k, found.last[k]] - found.seen.times_s[k, 0]) == pytest.approx(0.1, abs=0.011)
    errors = found._errors(found.model)
    away = (found.model - found.seen.position_m).norm(dim=-1)[..., 0]
    for k in range(2):
        assert float(errors[k]) == pytest.approx(float(away[k][found.after[k, :, 0]].mean()))
    assert float(errors.max()) < 0.02 and bool((found._errors(found._held(False)) > 0.05).all())
