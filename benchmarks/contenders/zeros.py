"""A frozen object and a ballistic one: so that every figure has its zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.phys_geo.images.video_episodes import kinematic_poses
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.schemas import ContactParameters

from .base import Array, Cell, Prediction
from .training import rolled_out


@dataclass(frozen=True)
class Frozen:
    """Whatever the free bodies do, they stay where they start."""

    name: str = "frozen"

    def fit(self, cell: Cell, budget_s: float | None) -> FittedZero:
        """Read the model; there is nothing to learn."""
        return FittedZero(_world(cell), False)


@dataclass(frozen=True)
class Ballistic:
    """The free bodies fly on through everything, by rigid-body dynamics without contact."""

    name: str = "ballistic"

    def fit(self, cell: Cell, budget_s: float | None) -> FittedZero:
        """Read the model; there is nothing to learn."""
        return FittedZero(_world(cell), True)


@dataclass(frozen=True, eq=False)
class FittedZero:
    """A world in which free bodies fly, each for itself, or do not move."""

    world: World
    flies: bool

    @property
    def record(self) -> dict[str, Any]:
        """Nothing was fitted."""
        return {"seconds": 0.0, "evaluations": 0, "parameters": {}}

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
        """Predict open loop."""
        world = self.world
        position, quat = (values.numpy() for values in kinematic_poses(world, drives, times_s))
        for index, body in enumerate(world.bodies):
            if body.motion == "driven":
                continue
            alone = State(*(getattr(start, key)[:, [index]] for key in start.__dataclass_fields__))
            if body.free and self.flies:
                flight = rolled_out(replace(world, bodies=(body,)), alone, {}, times_s)
                position[:, index], quat[:, index] = flight.position_m[:, 0], flight.quat_wxyz[:, 0]
            else:
                position[:, index], quat[:, index] = alone.position_m[0, 0], alone.quat_wxyz[0, 0]
        return Prediction(position, quat)


def _world(cell: Cell) -> World:
    """Return the model's world without a ground."""
    model = read_model(cell.splats)
    file = model.file.model_copy(update={"contact": ContactParameters()})
    world = world_of_model(replace(model, file=file))
    return replace(world, ground_normal=None, ground_offset=None)
