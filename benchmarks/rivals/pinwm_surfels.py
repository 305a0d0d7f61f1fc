"""PIN-WM's 2D Gaussian surfels of an object: fitted to the photos by its own training, kept in a file.

Its code to prepare data is not published. The first points are drawn, as in its example, in a box somewhat larger than
the object, here about its true place in the photos.
"""

from __future__ import annotations

import random
import tempfile
import time
from argparse import ArgumentParser
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.io.atomic import replaced_file
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import rest_pose
from cgwm.datasets.synthetic.objects import SolidObject
from scipy.spatial.transform import Rotation
from tabletop.objects import load_item

from .pinwm_frames import Array, Local, photos_of
from .source import module

ROOM = "diff_rendering.gaussian_splatting_2d"
SH_DEGREE, FIRST_POINTS, WIDER = 3, 10_000, 1.3
PARTS = ("_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity")


def seed_all(seed: int = 0) -> None:
    """Seed what it draws from, as it does; its own seed is 0."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def surfels(capture: Capture, solid: SolidObject, kept: Path, steps: int | None = None) -> tuple[Any, dict[str, Any]]:
    """Return an object's surfels in its simulator's frame of the body, and a record; trained where they are not kept.

    Args:
        capture: Whose photos.
        solid: The true object.
        kept: File that keeps them.
        steps: Of training; None for its own number.
    """
    if not kept.exists():
        found, record = _trained(capture, solid, steps)
        parts = {name: getattr(found, name).detach().cpu() for name in PARTS}
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replaced_file(kept) as partial:
            torch.save({"parts": parts, "record": record}, partial)
    stored = torch.load(kept, weights_only=False)
    model = module(f"{ROOM}.scene.gaussian_model").GaussianModel(SH_DEGREE)
    model.active_sh_degree = SH_DEGREE
    for name, values in stored["parts"].items():
        setattr(model, name, values.cuda())
    return model, stored["record"]


def _trained(capture: Capture, solid: SolidObject, steps: int | None) -> tuple[Any, dict[str, Any]]:
    seed_all()
    views, pose = photos_of(capture), photo_pose(solid, read_truth(capture.root).seed)
    centres = np.stack([view.camera_center.cpu().numpy() for view in views])
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    training, settings = module(f"{ROOM}.train_2dgs"), _settings(steps)
    training.Scene = _scene(views, _first_points(solid, pose), extent)
    training.GaussianExtractor = _NoMesh
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        settings[0].model_path = folder
        model = training.training(*settings, [], [], [], None, None)
    seconds = time.perf_counter() - begun
    record = {"surfels": len(model._xyz), "steps": settings[1].iterations, "seconds": round(seconds, 1)}
    record["photos_psnr_db"] = round(float(np.mean([psnr_db(view, model) for view in views])), 2)
    placed = [torch.tensor(v, dtype=torch.float32, device="cuda") for v in Local.of(solid).pose(pose[:3], pose[3:7])]
    with torch.no_grad():
        model.translate2localframe(*placed)
    return model, record


def _settings(steps: int | None) -> list[Any]:
    """Return its model's, optimiser's and renderer's defaults."""
    arguments, parser = module(f"{ROOM}.arguments"), ArgumentParser()
    groups = [getattr(arguments, name)(parser) for name in ("ModelParams", "OptimizationParams", "PipelineParams")]
    parts = [group.extract(parser.parse_args([])) for group in groups]
    parts[1].iterations = steps or parts[1].iterations
    return parts


@cache
def _pipe() -> Any:
    return _settings(None)[2]


def _first_points(solid: SolidObject, pose: Array) -> Any:
    turn = Rotation.from_quat(pose[3:7], scalar_first=True).as_matrix()
    corners = solid.vertices @ turn.T + pose[:3]
    low, high = corners.min(0), corners.max(0)
    points = (low + high) / 2 + WIDER / 2 * (high - low) * np.random.uniform(-1, 1, (FIRST_POINTS, 3))
    cloud = module(f"{ROOM}.scene.dataset_readers").BasicPointCloud
    return cloud(points=points, colors=np.full((FIRST_POINTS, 3), 0.5), normals=np.zeros((FIRST_POINTS, 3)))


def _scene(views: list[Any], cloud: Any, extent: float) -> type:
    """Return what its training makes a scene of, with these cameras and first points."""

    class Scene:
        cameras_extent, model_path = extent, "."

        def __init__(self, args: Any, gaussians: Any, scene_info: Any = None) -> None:
            gaussians.create_from_pcd(cloud, extent)

        def getTrainCameras(self, scale: float = 1.0) -> list[Any]:
            return views

        def getTestCameras(self, scale: float = 1.0) -> list[Any]:
            return []

    return Scene


class _NoMesh:
    """In place of what makes pictures and a mesh of the surfels in the end, which nothing here uses."""

    def __init__(self, *given: Any, **named: Any) -> None:
        pass

    def reconstruction(self, views: list[Any]) -> None:
        """Do nothing."""

    def export_image(self, folder: str) -> None:
        """Do nothing."""


def photo_pose(solid: SolidObject, scene_seed: int) -> Array:
    """Return the true pose of an object in its photos, position and quat_wxyz (7,), as `make_capture` draws it."""
    item, rng = load_item(solid.family), np.random.default_rng([scene_seed, 20])
    return rest_pose(item.solid, item.down, rng.uniform(-np.pi, np.pi), *rng.uniform(-0.01, 0.01, 2))


def render(view: Any, model: Any) -> Any:
    """Return the picture (3, H, W) of surfels on white."""
    pipe = _pipe()
    white = torch.ones(3, device="cuda")
    return module(f"{ROOM}.gaussian_renderer").render(view, model, pipe, white, only_rgb_alpha=True)["render"]


@torch.no_grad()
def psnr_db(view: Any, model: Any) -> float:
    """Return the PSNR [dB] of surfels against a camera's picture."""
    return float(-10 * torch.log10((render(view, model) - view.original_image).square().mean()))
