"""Random effects: values of their own of every episode, whatever it begins with."""

from dataclasses import replace

import numpy as np
from cgwm.pipeline.physics.effects.effect import ActiveEffect
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.physics.parameters import effect_parameters
from cgwm.pipeline.segments.random_effects import fit_random_effects
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
