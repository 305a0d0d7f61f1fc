"""Stage sg-gs: from photos, masks and cameras to spherical Gaussians of every body and of the background."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ..datasets.capture import Capture
from ..datasets.ply import Splats
from ..schemas import Body, Ground, InputDataError, Pose, SplatConfig, UsageError
from .reporting.pictures import compared, separated, small_png
from .sfm.points import POINTS_NAME, read_points
from .splats.adaptive import fit_adaptively
from .splats.collision import CollisionSpheres, distil, shape_to_spheres
from .splats.fit import (
    Rates,
    Trainable,
    behind,
    body_loss,
    body_windows,
    camera_center,
    descend,
    mean_colors,
    psnr,
    render_view,
    scene_loss,
    silhouette_loss,
    ssim_map,
)
from .splats.hull import carve
from .splats.seeds import body_seeds, scene_seeds, to_spheres
from .splats.separation import separate
from .splats.shapes import shape_mass_properties, shape_volume
from .splats.spheres import Spheres
from .splats.stereo import refine
from .splats.views import View, load_views
from .splats.volume import Array, MassProperties, Volume, grid_points

_MIN_PHOTOS = 3
_START_SHARE = 0.3
"""Of a budget: spheres of the background at the beginning."""


@dataclass(frozen=True)
class BodyResult:
    """One body, in its body frame.

    Attributes:
        visual: What it looks like; None where nothing shows it (no photos).
        collision: What it collides with: spheres of radius `radius_factor` times the scale.
        collision_distance_m: Largest distance between the colliding spheres' surface and the body's solid [m].
        photo_pose: T_world_body while the photos were taken.
        mass_properties: Of a solid of uniform density.
    """

    visual: Splats | None
    collision: Splats
    collision_distance_m: float
    photo_pose: Pose
    mass_properties: MassProperties


@dataclass(frozen=True)
class SgGsResult:
    """What the stage makes.

    Attributes:
        bodies: By name, in the manifest's order.
        scene: The background, world frame, or None without photos.
        radius_factor: Collision radius in units of the Gaussian scale.
        record: Losses, timings and held-out figures, for fit.json.
        warnings: What the user should know.
        held_out: Contact sheet of the photos that the fit did not see, PNG, or None where it saw all.
        separation: Contact sheet of what was taken for bodies without masks, PNG, or None where there were none.
    """

    bodies: dict[str, BodyResult]
    scene: Splats | None
    radius_factor: float
    record: dict[str, Any]
    warnings: tuple[str, ...] = ()
    held_out: bytes | None = None
    separation: bytes | None = None


@dataclass
class _Stage:
    """What the steps of the stage share."""

    capture: Capture
    config: SplatConfig
    device: torch.device
    ground: Ground | None
    train: list[View]
    test: list[View]
    record: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def steps(self, share: float) -> int:
        return max(1, round(share * self.config.iterations))


def fit_scene(capture: Capture, config: SplatConfig | None = None) -> SgGsResult:
    """Fit spheres to the photos of a capture.

    Bodies need masks or a shape, or else a box or the ground to be separated by. With masks, a body's solid is its
    visual hull (or its shape); its spheres are fitted geometry first, to the silhouettes, then appearance. Everything
    else becomes the background. Without photos, bodies get colliding spheres from their shapes and no visual ones.

    Args:
        capture: The capture, calibrated where it has photos; the cameras may be unscaled.
        config: Settings.

    Raises:
        InputDataError: If a body has none of these, or photos have no cameras.
    """
    config = config or SplatConfig()
    started = time.perf_counter()
    stage = _open(capture, config)
    separation = _separated(stage)
    results: dict[str, BodyResult] = {}
    placed: list[Spheres] = []
    for index, body in enumerate(capture.manifest.bodies):
        results[body.name], world = _fit_body(stage, index, body)
        if world is not None:
            placed.append(world)
    scene = _fit_background(stage, placed) if stage.train else None
    sheet = None
    if stage.train:
        stage.record["held_out"], sheet = _held_out(stage, placed, scene)
    stage.record["seconds"] = round(time.perf_counter() - started, 2)
    splats = None if scene is None else scene.to_numpy()
    return SgGsResult(results, splats, config.radius_factor, stage.record, tuple(stage.warnings), sheet, separation)


def _open(capture: Capture, config: SplatConfig) -> _Stage:
    device = resolve_device(config.device)
    ground = capture.manifest.world.ground
    names = capture.photos()
    stage = _Stage(capture, config, device, ground, [], [])
    if not names:
        return stage
    if capture.cameras is None:
        raise InputDataError(
            f"{capture.root}: {len(names)} photos and no cameras.",
            "cameras.json, transforms.json or a COLMAP model.",
            f"run 'cgwm calibrate {capture.root}'.",
        )
    posed = [name for name in names if name in capture.cameras.images]
    if len(posed) < _MIN_PHOTOS:
        raise InputDataError(f"{capture.root}: {len(posed)} of {len(names)} photos have a camera.", "at least 3.")
    if len(posed) < len(names):
        stage.warnings.append(f"{len(names) - len(posed)} of {len(names)} photos have no camera and were not used.")
    if ground is not None and capture.cameras.scale.kind == "unscaled":
        stage.ground = None
        stage.warnings.append("The cameras are unscaled, so the ground's place among the photos is not known.")
    views = load_views(capture, posed, config.image_size, device)
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


def _separated(stage: _Stage) -> bytes | None:
    """Give the photos masks of bodies that have none; return a picture of them."""
    found = separate(stage.capture, stage.train, stage.test, stage.ground, _sparse_points(stage), stage.config)
    if found is None:
        return None
    stage.train, stage.test = found.train, found.test
    stage.record["separation"] = found.record
    stage.warnings += found.warnings
    masks = [(view.cover > 0.5).any(0).cpu().numpy() for view in found.train if view.cover is not None]
    return small_png(separated([_bytes(view.image) for view in found.train], masks), 3_000_000)


def _sparse_points(stage: _Stage) -> Array | None:
    path = stage.capture.root / POINTS_NAME
    return read_points(path)[0] if path.is_file() else None


def _fit_body(stage: _Stage, index: int, body: Body) -> tuple[BodyResult, Spheres | None]:
    """Return a body in its frame, and its visual spheres in the world frame where it has any."""
    masked = [view for view in stage.train if view.cover is not None and bool((view.cover[index] > 0.5).any())]
    if body.shape is None and not masked:
        raise InputDataError(
            f"{stage.capture.root}: body '{body.name}' has neither a shape nor masks.",
            f"shape = {{ box | sphere | mesh | splats }} in capture.toml, or masks/ with label {index + 1}.",
            "add one of them.",
        )
    solid = None
    T_world_body = _pose_matrix(body.photo_pose or Pose())
    if body.shape is None:
        solid = _hull(stage, index, body)
    elif masked:
        solid = _moved(shape_volume(body.shape, stage.capture.root, stage.config.radius_factor), T_world_body)
    elif stage.train:
        stage.warnings.append(
            f"body '{body.name}': no mask shows it, so that it has a shape for contact and no looks; masks/ with label "
            f"{index + 1} would give it some."
        )
    world = None if solid is None else _fit_spheres(stage, index, body, solid)
    if body.photo_pose is None and body.shape is None and world is not None:
        T_world_body = np.eye(4)
        T_world_body[:3, 3] = world.means.double().mean(0).cpu().numpy()
    T_body_world = np.linalg.inv(T_world_body)
    if body.shape is not None:
        collision, distance = shape_to_spheres(
            body.shape, stage.capture.root, stage.config.max_collision_spheres, stage.config.radius_factor
        )
        mass_properties = shape_mass_properties(body.shape, stage.capture.root, stage.config.radius_factor)
    else:
        assert solid is not None
        local = _moved(solid, T_body_world)
        spheres = distil(local, stage.config.max_collision_spheres, seed=stage.config.seed)
        collision, distance = spheres.splats(stage.config.radius_factor), spheres.distance_m
        mass_properties = _turned(solid.mass_properties(), T_body_world)
        stage.record[body.name]["collision"] = _collision_record(spheres)
    visual = None
    if world is not None and solid is not None:
        visual = world.moved(_tensor(T_body_world, stage.device)).to_numpy()
        nearest = KDTree(solid.surface).query(world.means.cpu().numpy())[1]
        visual = replace(visual, normals=solid.normals[nearest] @ T_body_world[:3, :3].T)
    pose = body.photo_pose or _pose(T_world_body)
    return BodyResult(visual, collision, distance, pose, mass_properties), world


def _hull(stage: _Stage, index: int, body: Body) -> Volume:
    silhouettes = [view.silhouette(index) for view in stage.train]
    hull = carve([one for one in silhouettes if one is not None], stage.ground, body.name)
    solid, refinement = refine(
        hull, [view for view in stage.train if view.labels is not None], index, stage.config.seed
    )
    stage.record[body.name] = {"refinement": asdict(refinement)}
    return solid


def _fit_spheres(stage: _Stage, index: int, body: Body, solid: Volume) -> Spheres:
    """Fit a body's visual spheres: silhouettes first, then colours with the geometry fixed."""
    config, device = stage.config, stage.device
    started = time.perf_counter()
    centers, scales, surface_count = body_seeds(solid, config.max_body_spheres, config.radius_factor, config.seed)
    spheres = to_spheres(centers, scales, 0.95, device)
    windows = body_windows(stage.train, index)
    geometry = Trainable(spheres, Rates(means=0.05, log_scales=0.02, logits=0.03))
    losses = descend(
        geometry, windows, silhouette_loss(index), stage.steps(0.25), config.seed, f"{body.name}: shape", 0.002
    )
    spheres = _detached(geometry.spheres())
    spheres = Spheres(spheres.means, spheres.scales, spheres.opacities, mean_colors(spheres, windows, index))
    appearance = Trainable(spheres, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.02))
    losses_appearance = descend(
        appearance, windows, body_loss(index), stage.steps(0.5), config.seed, f"{body.name}: colours", 0.002
    )
    spheres = _detached(appearance.spheres())
    stage.record[body.name] = stage.record.get(body.name, {}) | {
        "spheres": len(spheres),
        "surface_spheres": surface_count,
        "silhouette_loss": _thinned(losses),
        "appearance_loss": _thinned(losses_appearance),
        "seconds": round(time.perf_counter() - started, 2),
    }
    return spheres


def _fit_background(stage: _Stage, bodies: list[Spheres]) -> Spheres:
    config = stage.config
    started = time.perf_counter()
    points = _sparse_points(stage)
    if points is None and stage.ground is None:
        stage.warnings.append(f"No {POINTS_NAME} and no ground: the background starts from random points.")
    count = config.max_scene_spheres if config.spheres is None else max(16, int(_START_SHARE * config.spheres))
    centers, scales = scene_seeds(stage.train, stage.ground, points, count, config.seed)
    if len(scales) == 0:
        raise InputDataError(f"{stage.capture.root}: the photos show no background to fit.")
    spheres = to_spheres(centers, scales, 0.9 if config.spheres is None else 0.5, stage.device)
    standing = Spheres.joined(bodies) if bodies else None
    spheres = Spheres(
        spheres.means, spheres.scales, spheres.opacities, _background_colors(stage.train, standing, spheres)
    )
    if config.spheres is not None:
        return _adapted(stage, standing, spheres, config.spheres, started)
    trainable = Trainable(spheres, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
    losses = descend(trainable, stage.train, scene_loss(standing), stage.steps(0.75), config.seed, "background", 0.001)
    stage.record["scene"] = {
        "spheres": len(spheres),
        "loss": _thinned(losses),
        "seconds": round(time.perf_counter() - started, 2),
    }
    return _detached(trainable.spheres())


def _adapted(stage: _Stage, bodies: Spheres | None, start: Spheres, budget: int, started: float) -> Spheres:
    """Fit a background whose spheres multiply up to the budget."""
    config = stage.config

    def picture(spheres: Spheres, view: View) -> Tensor:
        return render_view(behind(bodies, spheres), view).features[0]

    spheres, history = fit_adaptively(
        start,
        stage.train,
        picture,
        budget=budget,
        degree=config.sh_degree,
        iterations=config.adaptive_iterations,
        spread=_spread(stage.train),
        seed=config.seed,
        what="background",
    )
    stage.record["scene"] = {
        "spheres": len(spheres),
        "sh_degree": config.sh_degree,
        "history": [asdict(entry) for entry in history],
        "seconds": round(time.perf_counter() - started, 2),
    }
    return spheres


def _spread(views: Sequence[View]) -> float:
    """Return the greatest distance of a camera from the cameras' mean [m], as a scale of the scene."""
    centers = np.stack([view.camera.center for view in views])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def _background_colors(views: Sequence[View], bodies: Spheres | None, spheres: Spheres) -> Tensor:
    """Return the background's mean colours, with the bodies standing before it."""
    return mean_colors(behind(bodies, spheres), views)[0 if bodies is None else len(bodies) :]


@torch.no_grad()
def _held_out(stage: _Stage, bodies: list[Spheres], scene: Spheres | None) -> tuple[dict[str, Any], bytes | None]:
    """Return PSNR, SSIM and mask IoU on the photos that the fit did not see, and a contact sheet of them."""
    parts = [*bodies, *([] if scene is None else [scene])]
    everything = Spheres.joined(parts)
    shown = sum(len(part) for part in bodies)
    label = torch.zeros(len(everything), 1, device=everything.means.device)
    label[:shown] = 1.0
    whole, similar, inside, overlap = [], [], [], []
    pictures: list[NDArray[np.uint8]] = []
    for view in stage.test:
        seen = everything.seen_from(camera_center(view.viewmat))
        colored = Spheres(seen.means, seen.scales, seen.opacities, torch.cat([seen.colors, label], 1))
        features = render_view(colored, view).features[0]
        picture = features[..., :3].clamp(0, 1)
        pictures.append(_bytes(picture))
        whole.append(psnr(picture, view.image))
        similar.append(float(ssim_map(picture, view.image).mean()))
        if view.cover is not None and bodies:
            true, mine = view.cover.sum(0) > 0.5, features[..., 3] > 0.5
            if true.any():
                inside.append(psnr(picture, view.image, true))
                overlap.append(float((true & mine).sum() / (true | mine).sum()))
    sheet = small_png(compared([_bytes(view.image) for view in stage.test], pictures), 3_000_000) if pictures else None
    figures = {
        "photos": [view.name for view in stage.test],
        "psnr_db": _mean(whole),
        "ssim": _mean(similar),
        "psnr_object_db": _mean(inside),
        "mask_iou": _mean(overlap),
        "psnr_db_by_photo": [round(value, 3) for value in whole],
    }
    return figures, sheet


def _bytes(picture: Tensor) -> NDArray[np.uint8]:
    return (picture * 255).round().to(torch.uint8).cpu().numpy()


def _collision_record(spheres: CollisionSpheres) -> dict[str, float]:
    return {
        "spheres": len(spheres.radii),
        "surface_distance_m": spheres.distance_m,
        "support_error_m": spheres.support_error_m,
    }


def _detached(spheres: Spheres) -> Spheres:
    return Spheres(spheres.means.detach(), spheres.scales.detach(), spheres.opacities.detach(), spheres.colors.detach())


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def _thinned(losses: list[float], count: int = 50) -> list[float]:
    """Return the losses averaged over equal stretches of iterations, for the record."""
    return [round(float(part.mean()), 6) for part in np.array_split(np.array(losses), min(count, len(losses)))]


def _moved(solid: Volume, T_to_from: Array) -> Volume:
    """Return a solid in another frame, on a grid of that frame."""
    rotation, offset = T_to_from[:3, :3], T_to_from[:3, 3]
    if np.allclose(rotation, np.eye(3)):
        return replace(solid, origin=solid.origin + offset, surface=solid.surface + offset)
    surface = solid.surface @ rotation.T + offset
    origin = surface.min(0) - 3 * solid.pitch
    shape = tuple(int(n) for n in np.ceil((surface.max(0) - origin) / solid.pitch).astype(int) + 4)
    points = (grid_points(shape, origin, solid.pitch) - offset) @ rotation
    inside = (solid.at(points) < 0).reshape(shape)
    return Volume.from_inside(inside, origin, solid.pitch, surface, solid.corner_count)


def _turned(properties: MassProperties, T_to_from: Array) -> MassProperties:
    rotation, offset = T_to_from[:3, :3], T_to_from[:3, 3]
    return MassProperties(
        properties.volume_m3,
        rotation @ properties.com_m + offset,
        rotation @ properties.inertia_m2 @ rotation.T,
    )


def _pose_matrix(pose: Pose) -> Array:
    w, x, y, z = pose.quat_wxyz
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = pose.position_m
    return T


def _pose(T_world_body: Array) -> Pose:
    """Return a pose without rotation: only bodies whose frame has the world's axes come here."""
    x, y, z = (float(value) for value in T_world_body[:3, 3])
    return Pose(position_m=(x, y, z))


def _tensor(array: Array, device: torch.device) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float32, device=device)
