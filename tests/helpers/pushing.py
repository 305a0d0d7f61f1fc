"""A cube and a finger: a task of control in small."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cgwm.datasets.models.model import Model
from cgwm.schemas import ControlTask
from helpers.small_model import HALF, small_model

RADIUS = 0.02
"""Of the finger: larger than the gaps between the cube's spheres [m]."""


def pushed_model(**options: Any) -> Model:
    """Return a cube of 27 colliding spheres on a table."""
    return small_model(**options)


def push_task(source: str = "the task", **sections: dict[str, Any]) -> ControlTask:
    """Return a task with short plans, in which some sections differ from the defaults."""
    small = {
        "robot": {"name": "tip", "radius_m": RADIUS, "height_m": HALF},
        "planner": {"horizon_s": 0.5, "knots": 5, "samples": 16, "control_hz": 20.0},
        "success": {"timeout_s": 0.3},
    }
    task = ControlTask.model_validate({name: {**small.get(name, {}), **sections.get(name, {})}
                                       for name in {*small, *sections}})  # fmt: skip
    task._source = source
    return task


def write_cube(folder: Path, half: float = HALF) -> str:
    """Write the true mesh of the cube, and return its name."""
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    faces = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    lines = ["v {} {} {}".format(*corner) for corner in corners] + ["f {} {} {} {}".format(*face) for face in faces]
    (folder / "cube.obj").write_text("\n".join(lines) + "\n")
    return "cube.obj"
