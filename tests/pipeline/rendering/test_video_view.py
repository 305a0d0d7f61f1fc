"""Cameras of video frames: an episode's own camera goes before that of all, and a moving one has a pose a frame."""

from types import SimpleNamespace

import numpy as np
import pytest
from cgwm.pipeline.rendering.video_view import expose, renderable, usable_cameras, video_view
from cgwm.schemas import Exposure

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


def test_cameras_are_usable_that_are_calibrated_for_all_episodes_or_this_one() -> None:
    cameras = SimpleNamespace(videos={"left": ONE, "right/001": ONE})
    capture = SimpleNamespace(cameras=cameras, videos=lambda episode: ["right", "top", "left"])
    assert usable_cameras(capture, "000") == (["left"], ["right", "top"])
    assert usable_cameras(capture, "001") == (["right", "left"], ["top"])
    capture.cameras = None
    assert usable_cameras(capture, "001") == ([], ["right", "top", "left"])


def test_an_exposure_scales_shifts_and_clips() -> None:
    pixels = np.array([[[0, 51, 255]]], np.uint8)
    found = expose(pixels, Exposure(gain_rgb=(2.0, 0.5, 0.9), offset_rgb=(-0.1, 0.2, 0.3)))
    np.testing.assert_allclose(found, [[[0.0, 0.3, 1.0]]], atol=1e-7)
    assert found.dtype == np.float32


@pytest.mark.parametrize(
    ("seen", "motions", "scene", "drawn"),
    [
        (("a",), ("free",), True, True),
        ((), ("free",), True, False),
        (("a",), ("free", "free"), True, False),
        (("a",), ("free", "driven"), True, True),  # what drives is not compared
        (("a",), ("free",), False, False),
        ((), (), True, True),
    ],
)
def test_a_model_is_compared_with_frames_that_shows_its_free_bodies(
    seen: tuple, motions: tuple, scene: bool, drawn: bool
) -> None:
    bodies = [SimpleNamespace(name=name, motion=motion) for name, motion in zip("ab", motions, strict=False)]
    file = SimpleNamespace(bodies=bodies)
    model = SimpleNamespace(file=file, body_splats=dict.fromkeys(seen), scene=object() if scene else None)
    assert renderable(model) == drawn
