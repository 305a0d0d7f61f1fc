"""The floor: our engine with the true numbers, the true shape and mass: what the contact model itself cannot express.

It alone reads the truth. MuJoCo's natural time and damping ratio of a contact are the contact time and damping ratio of
ours; friction belongs to the pair: that with the ground, and that with the fingertip. Shape is the true mesh, filled
with spheres, whose faces are flat where it fills its hull. Engines other than MuJoCo state the numbers that their
contacts were made from; `engine_floor.py` finds those that predict them best.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.datasets.shapes.meshes import mass_properties, read_mesh
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import FINGERTIP
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.physics.contact_law import ContactLaw
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.physics.world import State, World, symmetric
from cgwm.pipeline.sg_gs.collision_spheres import fills_hull, shape_to_spheres
from cgwm.schemas import ContactParameters, FileShape, Shape
from cgwm.schemas.materials import pair_of

from .base import Array, Cell, Prediction
from .training import rolled_out

_GROUND = "ground"
SPHERES = 200
"""Most collision spheres, as in `cgwm fit`."""


@dataclass(frozen=True)
class Floor:
    """The truth in our engine."""

    name: ClassVar[str] = "floor"

    def fit(self, cell: Cell, budget_s: float | None) -> FittedFloor:
        """Read the truth and fill the true mesh with spheres."""
        started = time.perf_counter()
        truth, model = read_truth(cell.capture), read_model(cell.splats)
        file = model.file.model_copy(update={"contact": ContactParameters()})
        world = World.from_model(replace(model, file=file))
        shape = Shape(mesh=FileShape(path=truth.object.mesh))
        factor = model.body(OBJECT).radius_factor
        spheres, distance = shape_to_spheres(shape, cell.capture, SPHERES, factor)

        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float64)[None]

        index = world.body_names.index(OBJECT)
        centers, radii = tensor(spheres.means), tensor(factor * spheres.scales)
        on_plane = plane_contacts(centers[0], radii[0])
        volume = mass_properties(read_mesh(cell.capture / truth.object.mesh)).volume_m3
        convex = fills_hull(np.asarray(spheres.means, float), factor * np.asarray(spheres.scales, float), volume)
        hull = Hull.of(centers[0], radii[0], on_plane) if convex else None
        body = replace(
            world.bodies[index],
            mass=tensor(truth.object.mass_kg),
            inertia=tensor(symmetric(truth.object.inertia_kg_m2)),
            com=tensor(truth.object.com_m),
            centers=centers,
            radii=radii,
            on_plane=on_plane,
            hull=hull,
            patch=None,
        )
        bodies = (*world.bodies[:index], body, *world.bodies[index + 1 :])
        contact = truth.contact
        numbers = {
            "friction": contact.friction,
            "contact_time_s": contact.natural_time_s,
            "damping_ratio": contact.damping_ratio,
        }
        laws = {
            name: ContactLaw(**{key: tensor(value) for key, value in (numbers | {"friction": friction}).items()})
            for name, friction in ((_GROUND, contact.friction), (FINGERTIP, contact.friction_fingertip))
            if friction is not None
        }
        record = {
            "seconds": round(time.perf_counter() - started, 2),
            "evaluations": 0,
            "parameters": numbers,
            "spheres": len(spheres.means),
            "surface_distance_m": distance,
        }
        pairs = {pair_of(OBJECT, FINGERTIP): laws[FINGERTIP]} if FINGERTIP in laws else {}
        bodies = tuple(replace(one, material=one.name) for one in bodies)
        world = replace(world, bodies=bodies, contact=laws[_GROUND], pair_laws=pairs, ground_material=_GROUND)
        return FittedFloor(world, record)


@dataclass(frozen=True, eq=False)
class FittedFloor:
    """The true world in our engine."""

    world: World
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop."""
        return rolled_out(self.world, start, drives, times_s)
