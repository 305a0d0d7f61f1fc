"""Stage sg-gs: from photos, masks and cameras to spherical Gaussians of every body and of the background."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..datasets.cameras import posed
from ..datasets.capture import Capture
from ..datasets.ply import Splats
from ..schemas import Body, CamerasFile, Ground, InputDataError, Pose, SplatConfig, UsageError
from .checkpoint import Checkpoint, Slot
from .held_out import HeldOut, look
from .reporting.pictures import separated, small_png
from .sfm.points import POINTS_NAME, read_points
from .splats.adaptive import fit_adaptively
from .splats.collision import distil, shape_to_spheres
from .splats.colors import mean_colors
from .splats.exposures import Exposures
from .splats.fit import Rates, Trainable, descend
from .splats.hull import carve
from .splats.losses import behind, body_loss, geometry_loss, scene_loss
from .splats.overlap import require_body_in_masks, require_points_in_view
from .splats.poses import Motions, motion_record, moved_for_good
from .splats.seeds import body_seeds, points_of_depth, scene_seeds, shows_bodies, to_spheres
from .splats.separation import separate
from .splats.shapes import shape_mass_properties, shape_volume
from .splats.spheres import Spheres
from .splats.stereo import refine
from .splats.surface import Union
from .splats.views import View, body_windows, load_views, spread_of
from .splats.volume import Array, MassProperties, Volume, grid_points
from .turntable import turntable, upward

_MIN_PHOTOS = 3
_FEW_IN_VIEW = 0.5
_START_SHARE = 0.3
"""Of a budget: spheres of the background at the beginning."""
_DEPTH_POINTS = 20_000
_SHEET_BYTES = 3_000_000
_UNEVEN_DB = 1.0
"""Photos that gain so much from an exposure each were not taken at one."""
_POSE_STEPS = 2.0
"""Steps that refine the cameras' poses without a budget of spheres, in units of the setting `iterations`."""


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


@dataclass
class _Stage:
    """What the steps of the stage share."""

    capture: Capture
    config: SplatConfig
    device: torch.device
    checkpoint: Checkpoint | None
    ground: Ground | None
    train: list[View]
    test: list[View]
    record: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @cached_property
    def exposures(self) -> Exposures:
        """What is known of the photos' exposures so far."""
        return Exposures(self.train, self.config.exposure)

    @cached_property
    def points(self) -> Array | None:
        """Points of the scene, world frame, (n, 3): from structure from motion, or from depth maps; or None."""
        path = self.capture.root / POINTS_NAME
        if not path.is_file():
            return points_of_depth(self.train, _DEPTH_POINTS, self.config.seed)
        found = read_points(path)[0]
        share = require_points_in_view(found, self.train, str(path))
        if share < _FEW_IN_VIEW:
            self.warnings.append(f"Only {share:.0%} of the points of {POINTS_NAME} lie in view of any photo.")
        return found

    @property
    def spread(self) -> float:
        """Size of the cameras' arrangement [m]."""
        return spread_of(self.train)

    def slot(self, name: str) -> Slot | None:
        return None if self.checkpoint is None else self.checkpoint.slot(name)

    def steps(self, share: float) -> int:
        return max(1, round(share * self.config.iterations))


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
        _refine_poses(stage)
    pictures = _separated(stage)
    results: dict[str, BodyResult] = {}
    placed: list[Spheres] = []
    for index, body in enumerate(capture.manifest.bodies):
        results[body.name], world = _fit_body(stage, index, body)
        if world is not None:
            placed.append(world)
    scene = _fit_background(stage, placed) if stage.train else None
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


def _refine_poses(stage: _Stage) -> None:
    """Move the cameras to where the photos say that they were, by a fit of the background that is then thrown away."""
    started = time.perf_counter()
    motions = Motions(stage.train, stage.spread)
    _background_spheres(stage, None, "camera poses", motions)
    found = motions.found(stage.train)
    stage.train = [moved_for_good(view, found[view.name]) for view in stage.train]
    stage.record["camera_poses"] = motion_record(found) | {"seconds": round(time.perf_counter() - started, 2)}


def _uneven(held_out: HeldOut, config: SplatConfig) -> list[str]:
    """Return a warning where photos differ in exposure and the fit took them as they are."""
    before, after = (held_out.figures[f"psnr_right_half_{name}db"] for name in ("", "corrected_"))
    if config.exposure or before is None or after - before < _UNEVEN_DB:
        return []
    return [
        f"Photos that the fit did not see agree {after - before:.1f} dB better when each has its own exposure: "
        "fit again with --exposure."
    ]


def _refined_cameras(stage: _Stage) -> CamerasFile:
    assert stage.capture.cameras is not None
    return posed(stage.capture.cameras, {view.name: view.camera.T_world_cam for view in stage.train})


def _open(capture: Capture, config: SplatConfig, checkpoint: Checkpoint | None) -> _Stage:
    device = resolve_device(config.device)
    ground = capture.manifest.world.ground
    names = capture.photos()
    stage = _Stage(capture, config, device, checkpoint, ground, [], [])
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


def _separated(stage: _Stage) -> dict[str, bytes]:
    """Give the photos masks of bodies that have none; return a picture of them, by its file's name."""
    found = separate(stage.capture, stage.train, stage.test, stage.ground, stage.points, stage.config)
    if found is None:
        return {}
    stage.train, stage.test = found.train, found.test
    stage.record["separation"] = found.record
    stage.warnings += found.warnings
    masks = [(view.cover > 0.5).any(0).cpu().numpy() for view in found.train if view.cover is not None]
    photos = [(view.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy() for view in found.train]
    return {"separation.png": small_png(separated(photos, masks), _SHEET_BYTES)}


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
        require_body_in_masks(solid.surface, masked, index, body.name)
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
        stage.record[body.name]["collision"] = {"support_error_m": spheres.support_error_m}
    visual = None
    if world is not None and solid is not None:
        visual = world.moved(_tensor(T_body_world, stage.device)).to_numpy()
        nearest = KDTree(solid.surface).query(world.means.cpu().numpy())[1]
        visual = replace(visual, normals=solid.normals[nearest] @ T_body_world[:3, :3].T)
        if stage.config.collision == "visual":
            collision = visual
            distance = float(_union(visual, stage.config).distance(_moved(solid, T_body_world).surface).max())
        _record_collision(stage, body.name, collision, visual, distance)
    pose = body.photo_pose or _pose(T_world_body)
    return BodyResult(visual, collision, distance, pose, mass_properties), world


def _hull(stage: _Stage, index: int, body: Body) -> Volume:
    silhouettes = [view.silhouette(index) for view in stage.train]
    hull = carve([one for one in silhouettes if one is not None], stage.ground, body.name)
    if any(view.depth_map is not None for view in stage.train):
        return hull  # depth maps have carved it where photos would have to be compared
    solid, refinement = refine(
        hull, [view for view in stage.train if view.labels is not None], index, stage.config.seed
    )
    stage.record[body.name] = {"refinement": asdict(refinement)}
    return solid


def _fit_spheres(stage: _Stage, index: int, body: Body, solid: Volume) -> Spheres:
    """Fit a body's visual spheres: geometry and colours together, or geometry first, which alone looks at maps."""
    config, device = stage.config, stage.device
    started = time.perf_counter()
    centers, scales, surface_count = body_seeds(solid, config.max_body_spheres, config.radius_factor, config.seed)
    spheres = to_spheres(centers, scales, 0.95, device)
    windows = body_windows(stage.train, index)
    geometry = Rates(means=0.05, log_scales=0.02, logits=0.03)
    maps = any(not (w.depth is None and w.normals is None and w.features is None) for w in windows)
    joint = not maps if config.joint is None else config.joint
    record: dict[str, Any] = {"spheres": len(spheres), "surface_spheres": surface_count, "joint": joint}
    if not joint:
        spheres, losses = _fit_geometry(stage, index, body, solid, spheres, windows, geometry)
        record["geometry_loss"] = _thinned(losses)
        rate = config.geometry_rate
        geometry = Rates(rate * geometry.means, rate * geometry.log_scales, geometry.logits)
    even = [stage.exposures.even(window) for window in windows]
    spheres = replace(spheres, colors=mean_colors(spheres, even, index))
    appearance = Trainable(spheres, replace(geometry, colors=0.02))
    losses = descend(
        appearance,
        windows,
        body_loss(index, stage.exposures),
        stage.steps(0.75 if joint else 0.5),
        config.seed,
        f"{body.name}: colours",
        0.002,
        exposures=stage.exposures,
        slot=stage.slot(f"{body.name} colours"),
    )
    record |= {"appearance_loss": _thinned(losses), "seconds": round(time.perf_counter() - started, 2)}
    stage.record[body.name] = stage.record.get(body.name, {}) | record
    return _detached(appearance.spheres())


def _fit_geometry(
    stage: _Stage, index: int, body: Body, solid: Volume, start: Spheres, windows: Sequence[View], rates: Rates
) -> tuple[Spheres, list[float]]:
    """Fit centres, scales and opacities to silhouettes and to what geometry maps there are."""
    with_features = [view for view in windows if view.features is not None]
    codes = start.means.new_zeros(len(start), 0)
    if with_features:
        as_pictures = [replace(view, image=view.features) for view in with_features]
        codes = mean_colors(start, as_pictures, index)
    geometry = Trainable(replace(start, colors=codes), replace(rates, colors=0.02 if with_features else 0.0))
    losses = descend(
        geometry,
        windows,
        geometry_loss(index, solid.size(), stage.config.radius_factor),
        stage.steps(0.25),
        stage.config.seed,
        f"{body.name}: shape",
        0.002,
        slot=stage.slot(f"{body.name} shape"),
    )
    return _detached(geometry.spheres()), losses


def _background_seeds(stage: _Stage, count: int, bodies: Spheres | None) -> Spheres:
    """Return spheres where the background begins: on the ground, on SfM points or depth maps, and far away."""
    if stage.points is None and stage.ground is None:
        where = "lies on a shell far away" if shows_bodies(stage.train) else "starts from random points"
        warning = f"No {POINTS_NAME} and no ground: the background {where}."
        stage.warnings += [warning] if warning not in stage.warnings else []
    centers, scales = scene_seeds(stage.train, stage.ground, stage.points, count, stage.config.seed)
    if len(scales) == 0:
        raise InputDataError(f"{stage.capture.root}: the photos show no background to fit.")
    spheres = to_spheres(centers, scales, 0.9 if stage.config.spheres is None else 0.5, stage.device)
    colors = mean_colors(behind(bodies, spheres), [stage.exposures.even(view) for view in stage.train])
    return replace(spheres, colors=colors if bodies is None else colors[len(bodies) :])


def _fit_background(stage: _Stage, bodies: list[Spheres]) -> Spheres:
    started = time.perf_counter()
    standing = Spheres.joined(bodies) if bodies else None
    spheres, record = _background_spheres(stage, standing, "background", None)
    seconds = round(time.perf_counter() - started, 2)
    stage.record["scene"] = {"spheres": len(spheres), **record, "seconds": seconds}
    return spheres


def _background_spheres(
    stage: _Stage, bodies: Spheres | None, what: str, motions: Motions | None
) -> tuple[Spheres, dict[str, Any]]:
    """Fit the spheres of the background, of which there are ever more where there is a budget; return how it went."""
    config = stage.config
    loss = scene_loss(bodies, stage.exposures, motions)
    slot = stage.slot(what)
    if config.spheres is None:
        start = _background_seeds(stage, config.max_scene_spheres, bodies)
        trainable = Trainable(start, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
        steps = stage.steps(0.75 if motions is None else _POSE_STEPS)
        losses = descend(trainable, stage.train, loss, steps, config.seed, what, 0.001, stage.exposures, motions, slot)
        return _detached(trainable.spheres()), {"loss": _thinned(losses)}
    start = _background_seeds(stage, max(16, int(_START_SHARE * config.spheres)), bodies)
    spheres, history = fit_adaptively(
        start,
        stage.train,
        loss,
        budget=config.spheres,
        degree=config.sh_degree,
        iterations=config.adaptive_iterations,
        spread=stage.spread,
        seed=config.seed,
        what=what,
        exposures=stage.exposures,
        motions=motions,
        slot=slot,
    )
    return spheres, {"sh_degree": config.sh_degree, "history": [asdict(entry) for entry in history]}


def _record_collision(stage: _Stage, name: str, collision: Splats, visual: Splats, distance: float) -> None:
    """Record how far what collides is from the solid, and from what is seen."""
    record: dict[str, Any] = {"set": stage.config.collision, "spheres": len(collision), "surface_distance_m": distance}
    if collision is not visual:
        there, back = _union(collision, stage.config).gaps(_union(visual, stage.config))
        record |= {"to_visual": asdict(there), "from_visual": asdict(back)}
    stage.record[name]["collision"] = stage.record[name].get("collision", {}) | record


def _union(splats: Splats, config: SplatConfig) -> Union:
    return Union.of(np.asarray(splats.means), config.radius_factor * np.asarray(splats.scales))


def _detached(spheres: Spheres) -> Spheres:
    return Spheres(spheres.means.detach(), spheres.scales.detach(), spheres.opacities.detach(), spheres.colors.detach())


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
