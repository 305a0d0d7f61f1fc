"""The stage sg-gs: fit spherical Gaussians of every body and of the background to photos, masks and cameras."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from ...datasets.capture.cameras import posed
from ...datasets.capture.capture import Capture
from ...datasets.io.progress import note
from ...datasets.shapes.ply import Splats
from ...schemas import CamerasFile, GroundShadow, InputDataError, SplatConfig, UsageError, Viewpoint
from ...schemas.printable import typed_path
from ..geometry.spheres import Spheres
from ..rendering.contact_sheets import SHEET_BYTES, separated, small_png
from ..runtime.checkpoint import Checkpoint
from ..runtime.device import resolve_device
from .background import fit_background, refine_poses
from .bodies import BodyResult, fit_body
from .context import Stage
from .ground.bare_ground import bare_ground
from .held_out import HeldOut, look
from .link_bodies import link_results
from .photos.views import COVERED, as_bytes, load_views, middle_view
from .separation.body_separation import separate
from .turntable import turntable, upward

_MIN_PHOTOS = 3
_UNEVEN_DB = 1.0
"""Threshold on the PSNR gain by individual exposures [dB], above which the photos differ in exposure."""


@dataclass(frozen=True, kw_only=True)
class SgGsResult:
    """Result of the stage."""

    bodies: dict[str, BodyResult]
    """Bodies by name, in the order of the manifest."""
    scene: Splats | None
    """Background spheres, world frame, or None without photos."""
    radius_factor: float
    """Collision radius in units of the Gaussian scale."""
    ground_shadow: GroundShadow | None = None
    """The shadow that bodies cast in the photos, or None if none was found."""
    first_view: Viewpoint | None = None
    """The photo in the middle of all; None without photos."""
    record: dict[str, Any]
    """Losses, timings and held-out figures, for fit.json."""
    warnings: tuple[str, ...] = ()
    """Messages for the user."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Pictures by file name: a contact sheet of the held-out photos, a turntable film, masks found by separation."""
    cameras: CamerasFile | None = None
    """Refined cameras of the photos, or None if they were not refined."""


def fit_scene(capture: Capture, config: SplatConfig | None = None, checkpoint: Checkpoint | None = None) -> SgGsResult:
    """Fit spheres to the photos of a capture.

    Bodies need masks or a shape, or else a box or the ground that separates them. With masks, the solid of a body is
    its visual hull (or its shape); the geometry of its spheres is fitted first, to silhouettes and geometry maps, then
    their appearance. Everything else becomes the background. Without photos, bodies get collision spheres from their
    shapes and no visual ones.

    Args:
        capture: The capture, calibrated where it has photos; the cameras may be unscaled.
        config: Settings.
        checkpoint: Checkpoints of the descents, from which they resume; None keeps none.

    Raises:
        InputDataError: If a body has none of these, photos have no cameras, or points and shapes lie where
            no photo shows them.
    """
    config = config or SplatConfig()
    started = time.perf_counter()
    stage = _open(capture, config, checkpoint)
    if config.collision == "visual" and not stage.train:
        raise UsageError(
            "--collision visual: no photos, hence no visual spheres to collide.",
            "distilled (the default): spheres made from the shapes in capture.toml.",
            "leave the option out, or add photos and masks.",
        )
    if stage.train and config.refine_poses:
        refine_poses(stage)
    pictures = _separated(stage)
    results, standing = _bodies(stage)
    placed = list(standing.values())
    scene = fit_background(stage, placed) if stage.train else None
    if stage.train:
        pictures |= _checked(stage, placed, scene)
    shadow = None
    if scene is not None and config.bare_ground:
        moving = [body.name for body in capture.manifest.bodies if body.motion != "fixed"]
        scene, shadow = bare_ground(stage, scene, [spheres for name, spheres in standing.items() if name in moving])
    stage.record["seconds"] = round(time.perf_counter() - started, 2)
    return SgGsResult(
        bodies=results,
        scene=None if scene is None else scene.to_numpy(),
        radius_factor=config.radius_factor,
        ground_shadow=shadow,
        first_view=middle_view(stage.train) if stage.train else None,
        record=stage.record,
        warnings=tuple(stage.warnings),
        pictures=pictures,
        cameras=_refined_cameras(stage),
    )


def _bodies(stage: Stage) -> tuple[dict[str, BodyResult], dict[str, Spheres]]:
    """Return the results of all bodies, and the visual spheres of those that photos show, where they lie."""
    links = link_results(stage.capture, stage.config)
    results: dict[str, BodyResult] = {}
    standing: dict[str, Spheres] = {}
    for index, body in enumerate(stage.capture.manifest.bodies):
        if body.name in links:
            results[body.name] = links[body.name]
            continue
        results[body.name], world = fit_body(stage, index, body)
        if world is not None:
            standing[body.name] = world
    return results, standing


def _refined_cameras(stage: Stage) -> CamerasFile | None:
    """Return the cameras of the photos with their refined poses; None if they were not refined."""
    cameras = stage.capture.cameras
    if cameras is None or not (stage.train and stage.config.refine_poses):
        return None
    return posed(cameras, {view.name: view.camera.T_world_cam for view in stage.train})


def _checked(stage: Stage, bodies: list[Spheres], scene: Spheres | None) -> dict[str, bytes]:
    """Record the errors on held-out photos; return their contact sheet and the turntable film by file name."""
    config, pictures = stage.config, {}
    note("sg-gs: held-out photos")
    learned = stage.exposures if config.exposure else None
    held_out = look(stage.test, bodies, scene, stage.spread, poses=config.refine_poses, exposures=learned)
    if config.exposure:
        stage.record["exposure_gain_rgb"] = stage.exposures.record()
    stage.record["held_out"] = held_out.figures
    stage.warnings += _uneven(held_out, config)
    if held_out.sheet is not None:
        pictures["held_out.png"] = held_out.sheet
    if config.turntable:
        up = upward(stage.train, stage.ground and stage.ground.normal)
        pictures["turntable.mp4"] = turntable(stage.train, bodies, scene, up)
    return pictures


def _uneven(held_out: HeldOut, config: SplatConfig) -> list[str]:
    """Return a warning if the photos differ in exposure and the fit did not correct it."""
    before, after = (held_out.figures[f"psnr_right_half_{name}db"] for name in ("", "corrected_"))
    if config.exposure or before is None or after - before < _UNEVEN_DB:
        return []
    return [
        f"The held-out photos agree {after - before:.1f} dB better with an individual exposure each: "
        "fit again with --exposure."
    ]


def _open(capture: Capture, config: SplatConfig, checkpoint: Checkpoint | None) -> Stage:
    device = resolve_device(config.device)
    ground = capture.manifest.world.ground
    names = capture.photos()
    stage = Stage(
        capture=capture, config=config, device=device, checkpoint=checkpoint, ground=ground, train=[], test=[]
    )
    if not names:
        return stage
    if capture.cameras is None:
        raise InputDataError(
            f"{capture.root}: {len(names)} photos and no cameras.",
            "cameras.json, transforms.json or a COLMAP model.",
            f"run 'cgwm calibrate {typed_path(capture.root)}'.",
        )
    known = [name for name in names if name in capture.cameras.images]
    if len(known) < _MIN_PHOTOS:
        raise InputDataError(
            f"{capture.root}: {len(known)} of {len(names)} photos have a camera.",
            "at least 3.",
            "run 'cgwm calibrate' on more photos, or remove those without a camera.",
        )
    if len(known) < len(names):
        stage.warnings.append(f"{len(names) - len(known)} of {len(names)} photos have no camera and were not used.")
    if ground is not None and capture.cameras.scale.kind == "unscaled":
        stage.ground = None
        stage.warnings.append(
            "The cameras are unscaled, so the position of the ground relative to the photos is unknown."
        )
    if capture.manifest.bodies and capture.cameras.scale.kind == "unscaled":
        stage.warnings.append(
            "The cameras are unscaled: lengths of bodies are in the units of the reconstruction, not in metres. Give a "
            "marker or a known distance in capture.toml, [calibration], and calibrate again."
        )
    views = load_views(capture, known, config.image_size, device)
    held_out = len(views) > config.test_every
    stage.test = views[:: config.test_every] if held_out else []
    stage.train = [view for view in views if view not in stage.test]
    stage.record["photos"] = {"train": len(stage.train), "held_out": len(stage.test)}
    return stage


def _separated(stage: Stage) -> dict[str, bytes]:
    """Add masks of bodies that have none to the photos; return a picture of the masks by file name."""
    found = separate(stage.capture, stage.train, stage.test, stage.ground, stage.points, stage.config)
    if found is None:
        return {}
    stage.train, stage.test = found.train, found.test
    stage.record["separation"] = found.record
    stage.warnings += found.warnings
    masks = [(view.cover > COVERED).any(0).cpu().numpy() for view in found.train if view.cover is not None]
    photos = [as_bytes(view.image) for view in found.train]
    return {"separation.png": small_png(separated(photos, masks), SHEET_BYTES)}
