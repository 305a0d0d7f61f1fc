"""Half of the frames hold less information on the same motion: names stay, numbers agree, intervals grow."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from cgwm.pipeline.diagnose.flight.findings import _Search, flight_findings
from cgwm.pipeline.physics.effects import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import prepare
from helpers.diagnosis_data import tosses, world_with

NAMES = ("linear_drag", "gravity_tilt", "length_scale", "spin_damping")
CANDIDATES = [Candidate(name, load_effect(name)) for name in NAMES]


def search(every: int, candidates: Sequence[Candidate] = CANDIDATES) -> _Search:
    hidden = {"linear_drag": {"c": 0.4}, "gravity_tilt": {"tilt_x": 0.03, "tilt_y": 0.0}}
    world = world_with("ball", None, False)
    episodes = [
        (name, {body: replace(track, time_s=track.time_s[::every], position_m=track.position_m[::every],
                              quat_wxyz=track.quat_wxyz[::every]) for body, track in tracks.items()})
        for name, tracks in tosses(world_with("ball", hidden, False), 5, noise=(3e-4, 3e-3))
    ]  # fmt: skip
    return _Search(prepare(world, episodes), world, candidates)


def named(every: int) -> dict[str, dict[str, tuple[float, float]]]:
    asked = search(every)
    found = flight_findings(asked.prepared, asked.world, asked.candidates)
    return {step.best.name: step.best.estimates for step in found.steps if step.flagged}


def test_names_and_numbers_do_not_depend_on_the_frame_rate() -> None:
    full, half = named(1), named(2)
    assert list(full) == list(half) == ["linear_drag", "gravity_tilt"]
    for name, numbers in full.items():
        for parameter, (value, std) in numbers.items():
            other, wider = half[name][parameter]
            assert value == pytest.approx(other, abs=3 * float(np.hypot(std, wider)))


def test_effects_of_an_earlier_search_stay_where_a_later_one_finds_worse_ones() -> None:
    """Under other errors one effect that imitates two may come first, and end the search."""
    asked, narrow = search(2, CANDIDATES[:2]), search(2, CANDIDATES[2:3])
    beside = asked.beside(None)
    two, one = asked.selection(beside), narrow.selection(narrow.beside(None))
    assert (two.names, one.names) == (["linear_drag", "gravity_tilt"], ["length_scale"])
    for found, before in ((one, two), (two, one)):
        assert asked.likelier(beside, found, before).names == two.names
