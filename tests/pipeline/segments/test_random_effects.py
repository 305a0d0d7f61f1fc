"""Random effects: values of their own of every episode, whatever it begins with."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.physics.effects.effect import ActiveEffect
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.physics.parameters import effect_parameters
from cgwm.pipeline.segments import random_effects
from cgwm.pipeline.segments.random_effects import fit_random_effects, with_fitted_groups
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import NOISE, tosses, world_with


def test_an_episode_that_begins_in_contact_has_a_value_of_its_own() -> None:
    """It has no flight; its end shows the tilt of the frame by the plane on which it lies."""
    plain = world_with("cube")
    episodes = tosses(plain, 3, count=4, duration_s=1.2)
    (name, begun), *_ = episodes[1][1].items()
    episodes[1] = ("001", {name: begun.window(float(begun.time_s[-20]))})
    world = replace(plain, effects=(ActiveEffect.of(load_effect("frame_tilt@episode"), like=plain.gravity[0, :1]),))
    wanted = [(parameter, 0.0) for parameter in effect_parameters(world)]
    found = fit_random_effects(world, episodes, {}, wanted, (), Noise(*NOISE), False, 0.0)
    assert sorted(found.own_values) == ["000", "001", "002", "003"]
    tilts = np.array([list(values.values()) for values in found.own_values.values()])
    assert np.abs(tilts).max() < 0.05


def test_only_episodes_that_the_fit_has_not_seen_are_fitted_about_its_means(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = world_with("cube")
    tilt = replace(ActiveEffect.of(load_effect("frame_tilt@episode"), {}, plain.gravity[0, :1]))
    means = {name: plain.gravity[0, :1] * 0 + value for name, value in {"tilt_x": 0.01, "tilt_y": -0.02}.items()}
    world = replace(plain, effects=(replace(tilt, values=means),))
    known = {"frame_tilt.tilt_x": 0.5, "frame_tilt.tilt_y": 0.6}
    entry = {"tilt_x": 0.5, "tilt_y": 0.6}
    effect = SimpleNamespace(name="frame_tilt@episode", own={"000": entry, "001": entry}, spread={"tilt_x": 0.003})
    monkeypatch.setattr(random_effects, "effect_of", lambda _: tilt.effect)
    monkeypatch.setattr("cgwm.pipeline.segments.group_parameters.effect_of", lambda _: tilt.effect)
    episodes, asked = [Episode(*one) for one in tosses(plain, 3, count=3, duration_s=0.3)], []

    def fitted(start: Any, *words: Any) -> Any:
        asked.append((start, *words))
        own = {**start.own_values, "002": {"frame_tilt.tilt_x": 0.7, "frame_tilt.tilt_y": 0.8}}
        return SimpleNamespace(world=replace(start, own_values=own))

    monkeypatch.setattr(random_effects, "fit_random_effects", fitted)
    file: Any = SimpleNamespace(effects=[effect])
    found = with_fitted_groups(world, episodes, file, {}, Noise(*NOISE))
    assert found.own_values == {"000": known, "001": known, "002": {"frame_tilt.tilt_x": 0.7, "frame_tilt.tilt_y": 0.8}}
    ((start, unknown, groups, wanted, free, noise, flying, model_error, ties),) = asked
    assert start.own_values == {"000": known, "001": known}
    assert ([name for name, _ in unknown], groups, free, noise) == (["002"], {}, (), Noise(*NOISE))
    assert [(p.name, value) for p, value in wanted] == [("frame_tilt.tilt_x", 0.01), ("frame_tilt.tilt_y", -0.02)]
    assert (flying, model_error, ties.spread) == (True, 0.0, {"frame_tilt.tilt_x": 0.003})
    assert ties.mean == {"frame_tilt.tilt_x": 0.01, "frame_tilt.tilt_y": -0.02}
    assert with_fitted_groups(world, episodes[:2], file, {}, Noise(*NOISE)).own_values == {"000": known, "001": known}
    assert len(asked) == 1 and math.isfinite(float(found.gravity.sum()))
