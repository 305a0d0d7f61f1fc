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
from typing import Any

from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic import read_truth
from cgwm.pipeline.demo.truth_tables import OBJECT
from cgwm.pipeline.physics.inertia import symmetric
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.schemas import ContactParameters
from tabletop.true_world import Numbers, on_true_ground, spheres_in, true_body

from .base import Array, Cell, Prediction
from .training import rolled_out


@dataclass(frozen=True)
class Floor:
    """The truth in our engine."""

    name: str = "floor"

    def fit(self, cell: Cell, budget_s: float | None) -> FittedFloor:
        """Read the truth and fill the true mesh with spheres."""
        started = time.perf_counter()
        truth, model = read_truth(cell.capture), read_model(cell.splats)
        file = model.file.model_copy(update={"contact": ContactParameters()})
        world = world_of_model(replace(model, file=file))
        true, contact = truth.object, truth.contact
        spheres = spheres_in(cell.capture, true.mesh)
        index = world.body_names.index(OBJECT)
        body = true_body(spheres, true.mass_kg, true.com_m, symmetric(true.inertia_kg_m2))
        world = replace(world, bodies=(*world.bodies[:index], body, *world.bodies[index + 1 :]))
        numbers = Numbers(contact.natural_time_s, contact.damping_ratio)
        record = {
            "seconds": round(time.perf_counter() - started, 2),
            "evaluations": 0,
            "parameters": {"friction": contact.friction, **vars(numbers)},
            "spheres": len(spheres.radii),
            "surface_distance_m": spheres.distance_m,
        }
        return FittedFloor(on_true_ground(world, contact.friction, contact.friction_fingertip, numbers), record)


@dataclass(frozen=True, eq=False)
class FittedFloor:
    """The true world in our engine."""

    world: World
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop."""
        return rolled_out(self.world, start, drives, times_s)
