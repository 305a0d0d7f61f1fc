"""Stage sg-gs: from photos, masks and cameras to spherical Gaussians of every body and of the background."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import torch

from ..datasets.cameras import posed
from ..datasets.capture import Capture
from ..datasets.ply import Splats
from ..schemas import CamerasFile, InputDataError, SplatConfig, UsageError
from .checkpoint import Checkpoint
from .held_out import HeldOut, look
from .reporting.pictures import SHEET_BYTES, separated, small_png
from .sg_gs_background import fit_background, refine_poses
from .sg_gs_bodies import BodyResult, fit_body
from .sg_gs_stage import Stage
from .splats.separation import separate
from .splats.spheres import Spheres
from .splats.views import as_bytes, load_views
from .turntable import turntable, upward

_MIN_PHOTOS = 3
_UNEVEN_DB = 1.0
"""Photos that gain so much from an exposure each were not taken at one."""


@dataclass(frozen=True)
class SgGsResult:
    """What the stage makes.

    Attributes:
        bodies: By name, in the manifest's order.
        scene: The background, world frame, or None without photos.
        radius_factor: Collision radius in units of the Gaussian scale.
        record: Losses, timings and held-out figures, for fit.json.
        warnings: What the user should know.
        pictures: What there is to look at, by file name: a contact sheet of the photos that the fit did not see, a
            film around what was fitted.
        cameras: The photos' cameras as they were refined, or None where they stayed.
    """

    bodies: dict[str, BodyResult]
    scene: Splats | None
    radius_factor: float
    record: dict[str, Any]
    warnings: tuple[str, ...] = ()
    pictures: dict[str, bytes] = field(default_factory=dict)
    cameras: CamerasFile | None = None


def fit_scene(capture: Capture, config: SplatConfig | None = None, checkpoint: Checkpoint | None = None) -> SgGsResult:
    """Fit spheres to the photos of a capture.

    Bodies need masks or a shape, or else a box or the ground to be separated by. With masks, a body's solid is its
    visual hull (or its shape); its spheres are fitted geometry first, to silhouettes and geometry maps, then
    appearance. Everything else becomes the background. Without photos, bodies get colliding spheres from their shapes
    and no visual ones.

    Args:
        capture: The capture, calibrated where it has photos; the cameras may be unscaled.
        config: Settings.
        checkpoint: Where the state of the descents goes, and from where they are taken up; None keeps none.

    Raises:
        InputDataError: If a body has none of these, photos have no cameras, or points and shapes lie where
            no photo shows them.
    """
    config = config or SplatConfig()
    started = time.perf_counter()
    stage = _open(capture, config, checkpoint)
    if config.collision == "visual" and not stage.train:
        raise UsageError(
            "--collision visual: no photos, so that there are no visual spheres to collide.",
            "distilled (the default): spheres made from the shapes in capture.toml.",
            "leave the option out, or add photos and masks.",
        )
    if stage.train and config.refine_poses:
        refine_poses(stage)
    pictures = _separated(stage)
    results: dict[str, BodyResult] = {}
    placed: list[Spheres] = []
    for index, body in enumerate(capture.manifest.bodies):
        results[body.name], world = fit_body(stage, index, body)
        if world is not None:
            placed.append(world)
    scene = fit_background(stage, placed) if stage.train else None
    if stage.train:
        held_out = look(stage.test, placed, scene, stage.spread, poses=config.refine_poses)
        if config.exposure:
            stage.record["exposure_gain_rgb"] = stage.exposures.record()
        stage.record["held_out"] = held_out.figures
        stage.warnings += _uneven(held_out, config)
        if held_out.sheet is not None:
            pictures["held_out.png"] = held_out.sheet
        if config.turntable:
            up = upward(stage.train, stage.ground and stage.ground.normal)
            pictures["turntable.mp4"] = turntable(stage.train, placed, scene, up)
    stage.record["seconds"] = round(time.perf_counter() - started, 2)
    splats = None if scene is None else scene.to_numpy()
    cameras = _refined_cameras(stage) if stage.train and config.refine_poses else None
    return SgGsResult(results, splats, config.radius_factor, stage.record, tuple(stage.warnings), pictures, cameras)


def _uneven(held_out: HeldOut, config: SplatConfig) -> list[str]:
    """Return a warning where photos differ in exposure and the fit took them as they are."""
    before, after = (held_out.figures[f"psnr_right_half_{name}db"] for name in ("", "corrected_"))
    if config.exposure or before is None or after - before < _UNEVEN_DB:
        return []
    return [
        f"Photos that the fit did not see agree {after - before:.1f} dB better when each has its own exposure: "
        "fit again with --exposure."
    ]


def _refined_cameras(stage: Stage) -> CamerasFile:
    assert stage.capture.cameras is not None
    return posed(stage.capture.cameras, {view.name: view.camera.T_world_cam for view in stage.train})


def _open(capture: Capture, config: SplatConfig, checkpoint: Checkpoint | None) -> Stage:
    device = resolve_device(config.device)
    ground = capture.manifest.world.ground
    names = capture.photos()
    stage = Stage(capture, config, device, checkpoint, ground, [], [])
    if not names:
        return stage
    if capture.cameras is None:
        raise InputDataError(
            f"{capture.root}: {len(names)} photos and no cameras.",
            "cameras.json, transforms.json or a COLMAP model.",
            f"run 'cgwm calibrate {capture.root}'.",
        )
    known = [name for name in names if name in capture.cameras.images]
    if len(known) < _MIN_PHOTOS:
        raise InputDataError(f"{capture.root}: {len(known)} of {len(names)} photos have a camera.", "at least 3.")
    if len(known) < len(names):
        stage.warnings.append(f"{len(names) - len(known)} of {len(names)} photos have no camera and were not used.")
    if ground is not None and capture.cameras.scale.kind == "unscaled":
        stage.ground = None
        stage.warnings.append("The cameras are unscaled, so the ground's place among the photos is not known.")
    views = load_views(capture, known, config.image_size, device)
    held_out = len(views) > config.test_every
    stage.test = views[:: config.test_every] if held_out else []
    stage.train = [view for view in views if view not in stage.test]
    stage.record["photos"] = {"train": len(stage.train), "held_out": len(stage.test)}
    return stage


def resolve_device(name: str) -> torch.device:
    """Return the torch device for auto, cpu or cuda.

    Raises:
        UsageError: If CUDA was asked for and is not there.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device was found.", "auto, cpu, cuda.", "run 'cgwm doctor'.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _separated(stage: Stage) -> dict[str, bytes]:
    """Give the photos masks of bodies that have none; return a picture of them, by its file's name."""
    found = separate(stage.capture, stage.train, stage.test, stage.ground, stage.points, stage.config)
    if found is None:
        return {}
    stage.train, stage.test = found.train, found.test
    stage.record["separation"] = found.record
    stage.warnings += found.warnings
    masks = [(view.cover > 0.5).any(0).cpu().numpy() for view in found.train if view.cover is not None]
    photos = [as_bytes(view.image) for view in found.train]
    return {"separation.png": small_png(separated(photos, masks), SHEET_BYTES)}
