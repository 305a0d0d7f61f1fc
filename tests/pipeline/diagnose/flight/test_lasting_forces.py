"""A constant force acts as much late in the flights as early; a gust, which ends in the same place, does not."""

from dataclasses import replace

import numpy as np
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.flight.lasting_forces import without_lasting
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.segments.candidates import base_parameters
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.segment_fit import refit
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with

NOISE = Noise(3e-4, 1e-3)
TILT_RAD = 0.05


def gust(track: Track) -> Track:
    """Push the body sideways from 0.05 to 0.15 s, as far in the end as a tilt does in 0.4 s."""
    since = np.clip(track.time_s - 0.05, 0.0, None)
    push = 9.81 * TILT_RAD * 0.16 / 0.06 * 0.5 * (since**2 - np.clip(since - 0.1, 0.0, None) ** 2)
    return replace(track, position_m=track.position_m + push[:, None] * np.array([1.0, 0.0, 0.0]))


def test_a_gust_is_no_constant_force() -> None:
    world = world_with("ball")
    windy = tosses(world, 3, 6, 0.4, 148.0, NOISE, (0.9, 1.2))
    windy = [(episode, {body: gust(track) for body, track in tracks.items()}) for episode, tracks in windy]
    tilted = tosses(world_with("ball", {"gravity_tilt": {"tilt_y": TILT_RAD}}), 3, 6, 0.4, 148.0, NOISE, (0.9, 1.2))
    found = []
    for episodes in (windy, tilted):
        prepared = prepare(world, episodes, NOISE)
        assert prepared.flight is not None
        named = replace(world, effects=(ActiveEffect.of(load_effect("gravity_tilt"), {}, world.gravity[0, :1]),))
        fitted = refit([prepared.flight], named, base_parameters(named, "flight"))
        found.append(without_lasting(fitted.segments[0], fitted.world, ["gravity_tilt", "linear_drag"], 1.0))
    assert found == [{"gravity_tilt"}, set()]
