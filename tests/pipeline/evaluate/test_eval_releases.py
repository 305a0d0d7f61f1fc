"""An episode that begins in a hand is predicted from its release on, as fit and diagnose take it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with, write_capture

RATE_HZ, HELD_FRAMES = 100.0, 8


def test_the_frames_in_a_hand_are_no_part_of_the_warm_up(tmp_path: Path) -> None:
    world, capture = world_with("ball"), tmp_path / "capture"
    episodes = tosses(world, 3, 4, 0.4, RATE_HZ, Noise(3e-4, 1e-3), (0.6, 0.9))
    for _, tracks in episodes:
        ((body, track),) = tracks.items()
        before = np.clip(track.time_s[HELD_FRAMES] - track.time_s, 0, None)
        held = track.position_m + 0.5 * before[:, None] ** 2 * np.array([12.0, -8.0, 15.0])
        tracks[body] = replace(track, position_m=held)
    model = write_capture(capture, world, episodes)
    found = evaluate_model(read_model(model), Capture.open(capture))
    for name, one in zip(("002", "003"), found.episodes, strict=True):
        released_s = float(one.prediction.time_s[0])
        assert HELD_FRAMES / RATE_HZ - 1e-9 <= released_s <= (HELD_FRAMES + 4) / RATE_HZ
        assert any(f"episode '{name}' begins in a hand" in text for text in found.result.warnings)
    # with the hand in the warm-up its velocity is wrong by tenths of a metre per second
    assert found.result.translation_error_m.mean < 0.01
