"""Links of the jointed bodies of a capture as results of the stage: collision spheres from the files' geometry."""

from __future__ import annotations

import numpy as np

from ...datasets.capture.capture import Capture
from ...datasets.capture.links import articulations_of
from ...datasets.robots import Articulation, LinkOfRobot
from ...schemas import Pose, SplatConfig
from ..geometry.mesh import mesh_volume
from ..geometry.solid_grid import MassProperties
from ..geometry.surface_distance import Union
from .bodies import BodyResult
from .collision.collision_spheres import CollisionSpheres
from .collision.link_spheres import link_mesh, link_spheres

_NOTHING = MassProperties(1e-9, np.zeros(3), np.eye(3))
"""Mass properties of a link without geometry, which does not move."""


def link_results(capture: Capture, config: SplatConfig) -> dict[str, BodyResult]:
    """Return the links of all jointed bodies of a capture, by name; they have no visual spheres."""
    results: dict[str, BodyResult] = {}
    for found in articulations_of(capture.root, capture.manifest).values():
        results |= _results(capture, found, config)
    return results


def _results(capture: Capture, found: Articulation, config: SplatConfig) -> dict[str, BodyResult]:
    solid = sum(bool(link.geometry) for link in found.links)
    spheres = link_spheres(found, config.max_collision_spheres * max(solid, 1))
    return {
        link.name: _result(link, *spheres[link.name], config, capture.body(link.name).photo_pose or Pose())
        for link in found.links
    }


def _result(link: LinkOfRobot, centers: np.ndarray, radii: np.ndarray, config: SplatConfig, pose: Pose) -> BodyResult:
    collision = CollisionSpheres(centers, radii, 0.0, 0.0).splats(config.radius_factor)
    if not link.geometry:
        return BodyResult(
            visual=None, collision=collision, collision_distance_m=0.0, photo_pose=pose, mass_properties=_NOTHING
        )
    volume = mesh_volume(link_mesh(link))
    distance = float(np.abs(Union.of(centers, radii).distance(volume.surface)).max())
    return BodyResult(
        visual=None,
        collision=collision,
        collision_distance_m=distance,
        photo_pose=pose,
        mass_properties=volume.mass_properties(),
    )
