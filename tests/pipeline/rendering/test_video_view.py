"""Cameras of video frames: an episode's own camera goes before that of all, and a moving one has a pose a frame."""

from types import SimpleNamespace

import numpy as np
import pytest
from cgwm.pipeline.rendering.video_view import video_view

ONE, MOVING = SimpleNamespace(T_world_cam=np.eye(4)), SimpleNamespace(T_world_cam=np.stack([np.eye(4)] * 3))


@pytest.mark.parametrize(
    ("known", "frame"),
    [
        ({"left": ONE}, None),
        ({"left": MOVING}, 2),
        ({"left/000": MOVING}, 2),
        ({"left": MOVING, "left/000": ONE}, None),
        ({"left": ONE, "left/000": MOVING}, 2),
        ({"left": ONE, "left/001": MOVING}, None),
    ],
)
def test_a_frame_has_the_pose_of_its_camera(known: dict, frame: int | None) -> None:
    asked = []

    def camera(*what: object) -> SimpleNamespace:
        asked.append(what)
        return SimpleNamespace(width=8, height=6, resized=lambda *size: size)

    capture = SimpleNamespace(cameras=SimpleNamespace(videos=known), video_camera=camera)
    assert video_view(capture, "left", "000", 2, (8, 6)).width == 8
    assert video_view(capture, "left", "000", 2, (4, 3)) == (4, 3)
    assert asked == [("left", "000", frame)] * 2
