"""Masks and a known shape without photos: exact silhouettes, slopes by the poses, and poses found from them."""

import math
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.geometry.primitives import shape_mesh
from cgwm.pipeline.geometry.rotation import geodesic_angle, matrix_to_quat, quat_exp, quat_multiply, quat_to_matrix
from cgwm.pipeline.phys_geo.images.crops import Window
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseTracker, well_placed
from cgwm.pipeline.phys_geo.images.silhouette_loss import SilhouetteLoss, image_loss
from cgwm.pipeline.phys_geo.images.silhouettes import Outline, body_outlines, covered
from cgwm.pipeline.phys_geo.images.video_frames import Footage, Video, load_footage
from cgwm.schemas import BoxShape, InputDataError, Shape, SphereShape
from helpers.small_model import HALF, small_model
from helpers.tiny_capture import (
    CAMERAS,
    EPISODE,
    FRAMES,
    HEIGHT,
    WIDTH,
    model_of,
    thrown,
    tiny_model,
    write_tiny_capture,
)

BOX = Shape(box=BoxShape(half_extents_m=(HALF, HALF, HALF)))
F64 = torch.float64


def view_of(camera: Camera, size: tuple[int, int], covers: torch.Tensor | None = None, count: int = 1) -> Video:
    camera = camera.resized(*size)
    frames = torch.zeros(count, size[1], size[0], 3, dtype=F64)
    pose = torch.as_tensor(camera.T_cam_world).expand(count, 4, 4)
    return Video(
        camera="left",
        times_s=np.arange(count) / 30.0,
        frames=frames,
        covers=covers,
        K=torch.as_tensor(camera.K),
        viewmats=pose,
    )


def whole(video: Video, count: int = 1) -> Window:
    return Window(torch.arange(count), torch.zeros(count, 2, dtype=torch.int64), video.size)


def outline_of(shape: Shape, index: int = 0) -> Outline:
    mesh = shape_mesh(shape, Path())
    return Outline(index, torch.as_tensor(mesh.vertices), mesh.faces, HALF)


def pose(x: float, y: float, z: float, *turn: float) -> tuple[torch.Tensor, torch.Tensor]:
    quat = quat_exp(torch.tensor(turn or (0.0, 0.0, 0.0), dtype=F64))
    return torch.tensor([[[x, y, z]]], dtype=F64), quat.view(1, 1, 4)


def convex_area(video: Video, outline: Outline, position: torch.Tensor, quat: torch.Tensor) -> float:
    """Return the area of a convex body's silhouette: that of the hull of its projected corners."""
    points = outline.vertices @ quat_to_matrix(quat[0, 0]).T + position[0, 0]
    local = points @ video.viewmats[0, :3, :3].T + video.viewmats[0, :3, 3]
    pixels = (local[:, :2] / local[:, 2:]) * video.K.diagonal()[:2] + video.K[:2, 2]
    hull = cv2.convexHull(pixels.numpy().astype(np.float32))
    return float(cv2.contourArea(hull))


@pytest.mark.parametrize("shape", [BOX, Shape(sphere=SphereShape(radius_m=0.04))])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.8)])
def test_a_silhouette_has_the_area_of_the_projected_solid(shape: Shape, turn: tuple[float, ...]) -> None:
    video, outline = view_of(CAMERAS["left"], (128, 96)), outline_of(shape)
    at = pose(0.01, -0.02, 0.06, *turn)
    shares = covered(video, whole(video), [outline], 1, *at, 2e-3)
    expected = convex_area(video, outline, *at)
    assert float(shares.sum()) == pytest.approx(expected, rel=4e-3)
    assert 0.0 <= float(shares.min()) and float(shares.max()) == 1.0


def test_slopes_are_those_of_wider_differences() -> None:
    video, outline = view_of(CAMERAS["left"], (128, 96)), outline_of(BOX)
    row, column = torch.meshgrid(torch.arange(96, dtype=F64), torch.arange(128, dtype=F64), indexing="ij")
    weight = (0.3 + 0.2 * torch.sin(column / 9) + 0.2 * torch.cos(row / 7))[None, ..., None]

    def value(change: torch.Tensor) -> torch.Tensor:
        position, quat = pose(0.01, -0.02, 0.06, 0.3, -0.5, 0.8)
        turned = quat_multiply(quat, quat_exp(change[3:])[None, None])
        shares = covered(video, whole(video), [outline], 1, position + change[:3], turned, 2e-3)
        return (weight * shares).sum()

    zero = torch.zeros(6, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(zero), zero)
    for index, step in enumerate([6e-3] * 3 + [0.12] * 3):
        end = torch.zeros(6, dtype=F64)
        end[index] = step
        difference = float(value(end) - value(-end)) / (2 * step)
        assert float(slope[index]) == pytest.approx(difference, rel=0.1, abs=0.02 * float(slope.abs().max())), index


def test_the_nearer_body_hides_the_other() -> None:
    video = view_of(CAMERAS["left"], (128, 96))
    ball = Shape(sphere=SphereShape(radius_m=0.03))
    outlines = [outline_of(BOX, 0), outline_of(ball, 1)]
    eye = torch.as_tensor(CAMERAS["left"].center)
    box_at = torch.tensor([0.0, 0.0, 0.06], dtype=F64)
    for share, hidden in ((0.4, False), (-0.4, True)):
        ball_at = box_at + share * (eye - box_at)
        position = torch.stack([box_at, ball_at])[None]
        quat = torch.tensor([1.0, 0, 0, 0], dtype=F64).repeat(1, 2, 1)
        shares = covered(video, whole(video), outlines, 2, position, quat, 2e-3)
        assert float(shares.sum(-1).max()) <= 1 + 1e-6
        assert (float(shares[..., 1].sum()) < 1.0) == hidden


@pytest.mark.parametrize("cameras", [pytest.param(2, marks=pytest.mark.evidence), 1])
def test_poses_are_found_from_masks_alone(tmp_path: Path, cameras: int) -> None:
    """With two cameras to a fraction of a pixel (8 mm); with one, depth is what the size of the outline tells."""
    track, model = thrown(), small_model()
    assert track.quat_wxyz is not None
    position, quat = torch.as_tensor(track.position_m)[:, None], torch.as_tensor(track.quat_wxyz)[:, None]
    mesh = shape_mesh(BOX, Path())
    videos = []
    for camera in list(CAMERAS.values())[:cameras]:
        empty = view_of(camera, (WIDTH, HEIGHT), count=FRAMES)
        shares = covered(empty, whole(empty, FRAMES), [outline_of(BOX)], 1, position, quat, 2e-3)
        masks = (shares > 0.5).movedim(-1, 1)  # what a segmentation gives: whole pixels
        videos.append(replace(empty, frames=empty.frames.float(), covers=masks.float(), K=empty.K.float()))
        videos[-1] = replace(videos[-1], viewmats=videos[-1].viewmats.float())
    footage = Footage.of(EPISODE, tuple(videos))
    loss = image_loss(model, footage, [0], {"cube": mesh})
    assert isinstance(loss, SilhouetteLoss) and not loss.photometric and loss.gains == {}
    nothing = torch.zeros(FRAMES, 1, 3), torch.tensor([1.0, 0, 0, 0]).repeat(FRAMES, 1, 1)
    found = PoseTracker(loss, loss, *nothing).run()
    assert bool(found.found.all()) and float(found.quality.iou.median()) > 0.95
    away = (found.position_m - position)[:, 0]
    assert float(away.norm(dim=-1).median()) < (2e-3 if cameras == 2 else 2e-2)
    if cameras == 2:  # a cube looks the same from 24 sides
        angle = min(float(geodesic_angle(found.quat_wxyz[0, 0], other).item()) for other in _same_cubes(quat[0, 0]))
        assert angle < math.radians(5)
    truth, blank = loss.values(torch.arange(FRAMES), position, quat), loss.quality(torch.arange(FRAMES), position, quat)
    assert float(truth.max()) < 0.02 and bool(blank.found.all())
    assert float(loss.parts(torch.arange(FRAMES), position, quat)[:, 0].abs().max()) == 0.0


def test_instants_whose_place_is_far_less_certain_than_that_of_others_are_left_out() -> None:
    std_m = torch.tensor([4.0, 1.9, 1.0, 1.0, 0.8, 9.0, 9.0])
    found = torch.tensor([True, True, True, True, True, False, False])
    covariance = torch.eye(6, dtype=F64) * 100.0  # a ball's rotation is never certain
    covariance = covariance.repeat(len(std_m), 1, 1)
    covariance[:, :3, :3] = torch.eye(3, dtype=F64) * std_m[:, None, None] ** 2
    assert well_placed(covariance, found).tolist() == [False, True, True, True, True, False, False]


def _same_cubes(quat: torch.Tensor) -> list[torch.Tensor]:
    turns = []
    for order in permutations(range(3)):
        for signs in product((-1.0, 1.0), repeat=3):
            matrix = torch.zeros(3, 3, dtype=F64)
            for row, (column, sign) in enumerate(zip(order, signs, strict=True)):
                matrix[row, column] = sign
            if float(torch.linalg.det(matrix)) > 0:
                turns.append(quat_multiply(quat[None], matrix_to_quat(matrix)[None])[0])
    return turns


def test_a_model_without_photos_rests_on_masks_and_says_so(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    capture, model = Capture.open(root), tiny_model()
    assert body_outlines(model, capture, [EPISODE]) == ({}, [])
    bare = replace(model, scene=None)
    outlines, (text,) = body_outlines(bare, capture, [EPISODE])
    assert list(outlines) == ["cube"] and text.startswith("photometric part left out: the model has no background")
    blind = replace(model, body_splats={})
    _, (text,) = body_outlines(blind, capture, [EPISODE])
    assert "no visual spheres of the free body 'cube'" in text
    # where no shape is given, what collides is what is seen
    assert all(body.shape is None for body in model.file.bodies)
    assert np.abs(outlines["cube"].vertices).max() == pytest.approx(HALF, rel=0.05)
    (root / "video_masks" / "right").rename(root / "elsewhere")
    with pytest.raises(InputDataError, match=r"no background(.|\n)*camera 'right'(.|\n)*no masks(.|\n)*--stage all"):
        body_outlines(bare, capture, [EPISODE])
    with pytest.raises(InputDataError, match="no masks"):
        SilhouetteLoss(bare, load_footage(capture, EPISODE, 64), [0], outlines)
    assert model_of(root).is_dir()
