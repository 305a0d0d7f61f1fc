"""A body before a background of one colour is found without masks, box and ground."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera, to_intrinsics
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.synthetic.rig import look_at
from cgwm.pipeline.foreground.plain_background import foreground
from cgwm.pipeline.sg_gs.photos.views import load_views
from cgwm.pipeline.sg_gs.separation.body_separation import separate
from cgwm.schemas import CamerasFile, InputDataError, PosedImage, Scale, SplatConfig

SIZE, FOCAL, DISTANCE, RADIUS = 96, 120.0, 1.0, 0.2


def picture(backdrop: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy photo of a textured ball with a spot of the background's colour, and where the ball is."""
    rng = np.random.default_rng(seed)
    radius = FOCAL * RADIUS / np.sqrt(DISTANCE**2 - RADIUS**2)
    rows, columns = np.indices((SIZE, SIZE)) + 0.5
    ball = np.hypot(rows - SIZE / 2, columns - SIZE / 2) < radius
    texture = cv2.GaussianBlur(rng.uniform(40, 215, (SIZE, SIZE, 3)).astype(np.float32), (0, 0), 2)
    spot = np.hypot(rows - SIZE / 2, columns - SIZE / 2) < 5
    image = np.where((ball & ~spot)[..., None], texture, backdrop) + rng.normal(0, 2, (SIZE, SIZE, 3))
    return image.clip(0, 255).astype(np.uint8), ball


@pytest.mark.parametrize("backdrop", [0, 255])
def test_the_body_is_what_differs_from_the_border_with_its_holes_filled(backdrop: int) -> None:
    image, ball = picture(backdrop)
    found = foreground(image)
    assert found is not None and (found & ball).sum() / (found | ball).sum() > 0.95


def test_nothing_is_found_before_clutter_or_where_nothing_stands() -> None:
    rng = np.random.default_rng(0)
    clutter = cv2.GaussianBlur(rng.uniform(0, 255, (SIZE, SIZE, 3)).astype(np.float32), (0, 0), 1).astype(np.uint8)
    assert foreground(clutter) is None
    assert foreground(np.full((SIZE, SIZE, 3), 250, np.uint8)) is None


def capture(root: Path, clutter: bool) -> Capture:
    (root / "images").mkdir(parents=True)
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    images = {}
    for k in range(8):
        angle = 2 * np.pi * k / 8
        way = np.array([np.cos(angle), np.sin(angle), 0.6 * (-1) ** k])
        pose = look_at(DISTANCE * way / np.linalg.norm(way), np.zeros(3))
        camera = Camera(width=SIZE, height=SIZE, K=K, distortion=np.zeros(0), T_world_cam=pose)
        images[f"{k}.png"] = PosedImage(camera="a", T_world_cam=tuple(map(tuple, pose.tolist())))  # pyright: ignore[reportArgumentType]
        image, ball = picture(255, k)
        if clutter:
            noise = np.random.default_rng(k).uniform(0, 255, image.shape).astype(np.uint8)
            image = np.where(ball[..., None], image, noise)
        write_image(root / "images" / f"{k}.png", image)
    scale = Scale(kind="unscaled", source="")
    cameras = CamerasFile(scale=scale, cameras={"a": to_intrinsics(camera)}, images=images)
    (root / "cameras.json").write_text(cameras.model_dump_json())
    (root / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "ball"\n')
    return Capture.open(root)


def test_photos_before_a_plain_background_need_no_masks(tmp_path: Path) -> None:
    own = capture(tmp_path / "plain", clutter=False)
    views = load_views(own, own.photos(), SIZE, torch.device("cpu"))
    found = separate(own, views[1:], views[:1], None, None, SplatConfig())
    assert found is not None and found.record["ball"]["method"] == "plain"
    assert found.record["ball"]["agreement"] > 0.85
    assert "separated by what is before the plain background" in found.warnings[0]
    _, ball = picture(255)
    for view in [*found.train, *found.test]:
        assert view.labels is not None
        assert ((view.labels > 0) & ball).sum() / ((view.labels > 0) | ball).sum() > 0.93


def test_before_clutter_a_box_or_the_ground_is_asked_for(tmp_path: Path) -> None:
    own = capture(tmp_path / "clutter", clutter=True)
    views = load_views(own, own.photos(), SIZE, torch.device("cpu"))
    with pytest.raises(InputDataError, match=r"can be found neither by a box nor by the ground(.|\n)*plain background"):
        separate(own, views[1:], views[:1], None, None, SplatConfig())
