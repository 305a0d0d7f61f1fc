"""Bodies from photos: the solid, the visual spheres and the collision spheres of each."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.io.progress import note
from ...datasets.shapes.ply import Splats
from ...schemas import Body, InputDataError, Pose, SplatConfig
from ..geometry.primitives import shape_mass_properties, shape_volume
from ..geometry.solid_grid import Array, MassProperties, Volume, grid_points
from ..geometry.spheres import Spheres
from ..geometry.surface_distance import Union
from ..geometry.viewpoint import rotation_matrix
from .appearance.colors import VISIBLE_PX, mean_colors, observed_colors, spread_colors
from .appearance.gloss import fit_gloss
from .appearance.initialization import body_seeds, to_spheres
from .appearance.losses import body_loss, geometry_loss
from .appearance.optimize import Rates, Trainable, descend, detached, thinned
from .collision.collision_spheres import distil, shape_to_spheres
from .context import Stage
from .photos.view_overlap import require_body_in_masks
from .photos.views import COVERED, View, body_windows
from .solid.depth_refinement import refine
from .solid.facets import flatten_faces
from .solid.visual_hull import carve

OUTWARD, OUTWARD_PHOTOS = (0.0, 0.1, 0.2, 0.3, 0.4), 12
"""How far fitted spheres are tried to be moved out, in their scales, and photos in which that is judged, evenly
spread."""
SEEN_DEPTH = 0.7
"""How far below the surface spheres that are only seen lie at first, in collision radii: pictures show a surface where
they become opaque, which is less far out than they collide."""


@dataclass(frozen=True, kw_only=True)
class BodyResult:
    """One body, in its body frame."""

    visual: Splats | None
    """Visual spheres; None where no photo shows the body."""
    collision: Splats
    """Collision spheres, of radius `radius_factor` times the scale."""
    collision_distance_m: float
    """Largest distance between the surface of the collision spheres and the solid of the body [m]."""
    photo_pose: Pose
    """Pose T_world_body while the photos were taken."""
    mass_properties: MassProperties
    """Mass properties of the solid at uniform density."""


def fit_body(stage: Stage, index: int, body: Body) -> tuple[BodyResult, Spheres | None]:
    """Fit a body; return it in its body frame, and its visual spheres in the world frame if it has any."""
    masked = [view for view in stage.train if view.cover is not None and bool((view.cover[index] > COVERED).any())]
    if body.shape is None and not masked:
        raise InputDataError(
            f"{stage.capture.root}: body '{body.name}' has neither a shape nor masks.",
            f"shape = {{ box | sphere | mesh | splats }} in capture.toml, or masks/ with label {index + 1}.",
            "add one of them.",
        )
    T_world_body = _pose_matrix(body.photo_pose or Pose())
    note(f"{body.name}: shape from {len(masked)} photos")
    solid = _solid(stage, index, body, masked, T_world_body)
    felt = _felt(stage, index, body, solid)
    world = None if felt is None else _fit_spheres(stage, index, body, felt)
    if body.photo_pose is None and body.shape is None and world is not None:
        T_world_body = np.eye(4)
        T_world_body[:3, 3] = world.means.double().mean(0).cpu().numpy()
    T_body_world = np.linalg.inv(T_world_body)
    note(f"{body.name}: colliding spheres")
    collision, distance, mass_properties = _contact_properties(stage, body, felt, T_body_world)
    visual = None
    if world is not None and felt is not None:
        visual = world.moved(_tensor(T_body_world, stage.device)).to_numpy()
        nearest = KDTree(felt.surface).query(world.means.cpu().numpy())[1]  # flat faces have those of their planes
        visual = replace(visual, normals=felt.normals[nearest] @ T_body_world[:3, :3].T)
        if stage.config.collision == "visual":
            collision = visual
            distance = float(_union(visual, stage.config).distance(_moved(felt, T_body_world).surface).max())
        _record_collision(stage, body.name, collision, visual, distance)
    pose = body.photo_pose or _pose(T_world_body)
    return BodyResult(
        visual=visual,
        collision=collision,
        collision_distance_m=distance,
        photo_pose=pose,
        mass_properties=mass_properties,
    ), world


def _solid(stage: Stage, index: int, body: Body, masked: Sequence[View], T_world_body: Array) -> Volume | None:
    """Return the solid of a body in the world frame: its visual hull, or its shape where masks show it, else None."""
    if body.shape is None:
        return _hull(stage, index, body)
    if masked:
        solid = _moved(shape_volume(body.shape, stage.capture.root, stage.config.radius_factor), T_world_body)
        require_body_in_masks(solid.surface, masked, index, body.name)
        return solid
    if stage.train:
        stage.warnings.append(
            f"body '{body.name}': no mask shows it, so it has collision spheres and no visual spheres. To get visual "
            f"spheres, add masks/ with label {index + 1}."
        )
    return None


def _contact_properties(
    stage: Stage, body: Body, solid: Volume | None, T_body_world: Array
) -> tuple[Splats, float, MassProperties]:
    """Return collision spheres, their largest distance from the solid [m] and mass properties, in the body frame.

    Raises:
        ValueError: If the body has neither a shape nor a solid.
    """
    config = stage.config
    if body.shape is not None:
        collision, distance = shape_to_spheres(
            body.shape, stage.capture.root, config.max_collision_spheres, config.radius_factor
        )
        return collision, distance, shape_mass_properties(body.shape, stage.capture.root, config.radius_factor)
    if solid is None:
        raise ValueError(f"body '{body.name}' has neither a shape nor a solid.")
    spheres = distil(_moved(solid, T_body_world), config.max_collision_spheres, seed=config.seed)
    stage.record[body.name]["collision"] = {"support_error_m": spheres.support_error_m}
    return spheres.splats(config.radius_factor), spheres.distance_m, _turned(solid.mass_properties(), T_body_world)


def _hull(stage: Stage, index: int, body: Body) -> Volume:
    silhouettes = [view.silhouette(index) for view in stage.train]
    solid = carve([one for one in silhouettes if one is not None], stage.ground, body.name)
    if any(view.depth_map is not None for view in stage.train):
        return solid  # The depth maps have carved it already, so the photos need not be compared.
    views = [view for view in stage.train if view.labels is not None]
    solid, refinement = refine(solid, views, index, stage.config.seed)
    stage.record[body.name] = {"refinement": asdict(refinement)}
    return solid


def _felt(stage: Stage, index: int, body: Body, solid: Volume | None) -> Volume | None:
    """Return a solid from photos with flat faces where the photos show them."""
    if solid is None or body.shape is not None or not stage.config.flat_faces:
        return solid
    note(f"{body.name}: flat faces")
    views = [view for view in stage.train if view.labels is not None]
    felt, faces = flatten_faces(solid, views, index, stage.config.seed)
    stage.record.setdefault(body.name, {})["flat_faces"] = asdict(faces)
    return felt


def _fit_spheres(stage: Stage, index: int, body: Body, solid: Volume) -> Spheres:
    """Fit the visual spheres of a body: geometry and colours together, or geometry first (the only use of maps)."""
    config, device = stage.config, stage.device
    started = time.perf_counter()
    windows = body_windows(stage.train, index)
    geometry = Rates(means=0.05, log_scales=0.02, logits=0.03)
    maps = any(one is not None for view in windows for one in (view.depth, view.normals, view.features))
    joint = not maps if config.joint is None else config.joint
    # maps of depth are compared with the surface that collides
    depth = SEEN_DEPTH if joint and config.collision != "visual" else 1.0
    centers, scales, surface_count = body_seeds(
        solid, config.max_body_spheres, config.radius_factor, config.seed, depth
    )
    spheres = to_spheres(centers, scales, 0.95, device)
    record: dict[str, Any] = {"spheres": len(spheres), "surface_spheres": surface_count, "joint": joint}
    if not joint:
        spheres, losses = _fit_geometry(stage, index, body, solid, spheres, windows, geometry)
        record["geometry_loss"] = thinned(losses)
        rate = config.geometry_rate
        geometry = Rates(rate * geometry.means, rate * geometry.log_scales, geometry.logits)
    even = [stage.exposures.even(window) for window in windows]
    colors, seen = observed_colors(spheres, even, index)
    spheres = replace(spheres, colors=spread_colors(spheres.means, colors, seen))
    record["unseen_spheres"] = _say_unseen(body.name, solid, spheres, seen)
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
    fitted, gloss = detached(appearance.spheres()), {"degree": 0}
    if depth != 1.0:
        fitted, record["outward"] = _outward(stage, index, fitted, solid, windows)
    if config.gloss:
        even = [stage.exposures.even(window) for window in windows]
        fitted, gloss = fit_gloss(fitted, even, index, config.seed)
    record |= {"appearance_loss": thinned(losses), "seconds": round(time.perf_counter() - started, 2), "gloss": gloss}
    stage.record[body.name] = stage.record.get(body.name, {}) | record
    return fitted


@torch.no_grad()
def _outward(
    stage: Stage, index: int, spheres: Spheres, solid: Volume, windows: Sequence[View]
) -> tuple[Spheres, float]:
    """Move all spheres out by one share of their scales, which repeats the photos best, and return it.

    Spheres fade out over several pixels; losses that count sizes of differences, not squares, weigh their faint tails
    outside of the silhouette more than what they lack within, and hold the surface too far inside.
    """
    normals = solid.normals[KDTree(solid.surface).query(spheres.means.cpu().numpy())[1]]
    ways = spheres.scales[:, None] * torch.as_tensor(normals).to(spheres.means)
    wrong, compared = body_loss(index, stage.exposures), windows[:: max(1, len(windows) // OUTWARD_PHOTOS)]
    errors = []
    for share in OUTWARD:
        moved, generator = replace(spheres, means=spheres.means + share * ways), torch.Generator().manual_seed(0)
        errors.append(sum(float(wrong(moved, view, generator)[1]) for view in compared))
    share = OUTWARD[int(np.argmin(errors))]
    return replace(spheres, means=spheres.means + share * ways), share


def _say_unseen(name: str, solid: Volume, spheres: Spheres, seen: Tensor) -> int:
    """Return how many spheres at the surface of a body no photo shows, such as its underside, and say so."""
    outer = -solid.at(spheres.means.detach().cpu().numpy().astype(float)) < 2 * spheres.scales.cpu().numpy()
    hidden = int(((seen < VISIBLE_PX).cpu().numpy() & outer).sum())
    if hidden:
        note(f"{name}: {hidden} of {int(outer.sum())} spheres at its surface, which no photo shows, get the colours of "
             "those beside them")  # fmt: skip
    return hidden


def _fit_geometry(
    stage: Stage, index: int, body: Body, solid: Volume, start: Spheres, windows: Sequence[View], rates: Rates
) -> tuple[Spheres, list[float]]:
    """Fit centres, scales and opacities to the silhouettes and the available geometry maps."""
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
    return detached(geometry.spheres()), losses


def _record_collision(stage: Stage, name: str, collision: Splats, visual: Splats, distance: float) -> None:
    """Record the distances of the collision spheres from the solid and from the visual spheres."""
    record: dict[str, Any] = {"set": stage.config.collision, "spheres": len(collision), "surface_distance_m": distance}
    if collision is not visual:
        there, back = _union(collision, stage.config).gaps(_union(visual, stage.config))
        record |= {"to_visual": asdict(there), "from_visual": asdict(back)}
    stage.record[name]["collision"] = stage.record[name].get("collision", {}) | record


def _union(splats: Splats, config: SplatConfig) -> Union:
    return Union.of(np.asarray(splats.means), config.radius_factor * np.asarray(splats.scales))


def _moved(solid: Volume, T_to_from: Array) -> Volume:
    """Return a solid in another frame, on a grid of that frame."""
    rotation, offset = T_to_from[:3, :3], T_to_from[:3, 3]
    if np.allclose(rotation, np.eye(3)):
        return replace(
            solid,
            origin=solid.origin + offset,
            surface=solid.surface + offset,
            faces=solid.faces.moved(np.eye(3), offset),
        )
    surface = solid.surface @ rotation.T + offset
    origin = surface.min(0) - 3 * solid.pitch
    shape = tuple(int(n) for n in np.ceil((surface.max(0) - origin) / solid.pitch).astype(int) + 4)
    points = (grid_points(shape, origin, solid.pitch) - offset) @ rotation
    inside = (solid.at(points) < 0).reshape(shape)
    return Volume.from_inside(
        inside, origin, solid.pitch, surface, solid.corner_count, solid.faces.moved(rotation, offset)
    )


def _turned(properties: MassProperties, T_to_from: Array) -> MassProperties:
    rotation, offset = T_to_from[:3, :3], T_to_from[:3, 3]
    return MassProperties(
        properties.volume_m3,
        rotation @ properties.com_m + offset,
        rotation @ properties.inertia_m2 @ rotation.T,
    )


def _pose_matrix(pose: Pose) -> Array:
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(np.array(pose.quat_wxyz))
    T[:3, 3] = pose.position_m
    return T


def _pose(T_world_body: Array) -> Pose:
    """Return the pose of a body whose frame has the axes of the world."""
    x, y, z = (float(value) for value in T_world_body[:3, 3])
    return Pose(position_m=(x, y, z))


def _tensor(array: Array, device: torch.device) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float32, device=device)
