"""PIN-WM's simulator with the benchmark's scene: ground, object with its true shape, mass and inertia, fingertip."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from cgwm.datasets.synthetic.dynamics import FINGERTIP_RADIUS
from cgwm.datasets.synthetic.objects import SolidObject
from torch import Tensor

from .bullet import Shape
from .pinwm_frames import Array, Local
from .pinwm_surfels import seed_all
from .source import module

STEP_S = 1 / 240
RATE, INERTIA_RATE, OTHER_INERTIA_RATE = 2e-1, 1e-4, 2e-3
"""Of Adam, by its own script: of friction and restitution; of the object's inertia; of others'."""
FINGERTIP_KG = 1000.0
GROUND_M = (30.0, 30.0, 10.0)
STILL, STILL_STEPS = 1e-4, 10
"""A body this slow [m/s, 10 rad/s] for so many steps is at rest: what is predicted stays."""


FAILURES = (ArithmeticError, RuntimeError, TypeError, ValueError)
"""What its solver dies of: it has no error of its own."""


class Simulator:
    """The scene.

    Args:
        solid: The true object.
        fingertip_z_m: Height of the fingertip's centre, None for none.
    """

    def __init__(self, solid: SolidObject, fingertip_z_m: float | None) -> None:
        seed_all()
        self.local = Local.of(solid)
        self.sim = module("diff_simulation.simulator").Simulator(STEP_S, device="cpu", vis=False)
        joints = module("diff_simulation.constraints.base").Joint_Type
        ground = self._material(("mass", "inertia"))
        box = module("trimesh").creation.box(GROUND_M)
        self._add(box, ground, Shape((np.array(box.vertices),), fixed=True), [0.0, 0, -GROUND_M[2] / 2])
        self.sim.create_joint(0, joints.FIX_CONSTRAINT)
        body = self._material(
            ("mass",), mass=float(solid.mass), inertia=np.diag(self.local.moments / solid.mass).tolist()
        )
        parts = tuple(self.local.points(part) for part in solid.parts)
        hulls = [module("trimesh").convex.convex_hull(part) for part in parts]
        self._add(module("trimesh").util.concatenate(hulls), body, Shape(parts), [0.0, 0, 0.5])
        self.pushed = fingertip_z_m is not None
        if fingertip_z_m is not None:
            tip = self._material(("mass", "inertia"), mass=FINGERTIP_KG)
            ball = module("trimesh").creation.icosphere(2, FINGERTIP_RADIUS)
            self._add(ball, tip, Shape(radius_m=FINGERTIP_RADIUS), [5.0, 5, fingertip_z_m])
            self.sim.create_joint(2, joints.NO_TRANS_Z_CONSTRATNT)
            self.sim.create_joint(2, joints.NO_ROT_CONSTRATNT)
        self.materials = [one.physical_materials for one in self.sim.bodies]

    def _material(self, fixed: Sequence[str], **values: Any) -> Any:
        """Return numbers of a body, drawn as it draws them, but for those that are given."""
        one = module("diff_simulation.physical_material").Physical_Materials(requires_grad=True, device="cpu")
        for name, value in values.items():
            one.set_material(name, value)
        for name in fixed:
            one.no_optimize(name)
        return one

    def _add(self, mesh: Any, material: Any, shape: Shape, position_m: Sequence[float]) -> None:
        place = [_tensor(position_m), _tensor([1.0, 0, 0, 0])]
        self.sim.create_mesh_body(mesh, material, shape, True, *place)

    def frictions(self) -> dict[str, float]:
        """Return the friction of pairs: it multiplies those of two bodies."""
        values = [float(one.get_material("friction_coefficient")) for one in self.materials]
        tip = {"friction[fingertip,object]": values[1] * values[2]} if self.pushed else {}
        return {"friction": values[0] * values[1], **tip}

    def optimizer(self) -> torch.optim.Optimizer:
        """Return Adam on what is free, with its own rates."""
        groups = []
        for number, one in enumerate(self.materials):
            rates = {"inertia": INERTIA_RATE if number == 1 else OTHER_INERTIA_RATE}
            free = {name: value for name, value in one.all.items() if value.requires_grad}
            groups += [{"params": value, "lr": rates.get(name, RATE)} for name, value in free.items()]
        return torch.optim.Adam(groups)

    def numbers(self) -> list[dict[str, Tensor]]:
        """Return copies of the bodies' numbers as it optimises them."""
        return [{name: value.detach().clone() for name, value in one.all.items()} for one in self.materials]

    def set_numbers(self, numbers: Sequence[dict[str, Tensor]]) -> None:
        """Take numbers that `numbers` returned."""
        for one, values in zip(self.materials, numbers, strict=True):
            for name, value in values.items():
                one.all[name].data = value.clone()

    def rollout(
        self, start: Sequence[Array], times_s: Array, fingertip: Callable[[float], Array] | None
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield position [m] and quat_wxyz of the object's local frame at times; with gradients where they are on.

        Args:
            start: State at the first time, see `Local.state`.
            times_s: Times [s], shape (F,).
            fingertip: Where it is at a time.
        """
        sim, now, still = self.sim, float(times_s[0]), 0
        sim.reset()
        sim.change_body_pose(1, _tensor(start[0]), _tensor(start[1]))
        sim.change_body_vel(1, _tensor(start[2]), _tensor(start[3]))
        if fingertip is not None:
            sim.change_body_pose(2, _tensor(fingertip(now)))
        yield sim.get_body_pose(1)
        for until in times_s[1:]:
            for _ in range(max(1, round((float(until) - now) / STEP_S))):
                if still >= STILL_STEPS:
                    break
                if fingertip is not None:
                    velocity = (fingertip(now + STEP_S) - sim.get_body_pose_np(2)[0]) / STEP_S
                    sim.change_body_vel(2, _tensor([*velocity[:2], 0.0]), torch.zeros(3))
                sim.step()
                now += STEP_S
                still = still + 1 if self._rests(now, times_s[-1], fingertip) else 0
            now = float(until)
            yield sim.get_body_pose(1)

    def _rests(self, now: float, end: float, fingertip: Callable[[float], Array] | None) -> bool:
        """Return whether nothing moves any more; never where gradients are wanted."""
        if torch.is_grad_enabled():
            return False
        velocity, omega = (np.abs(values).max() for values in self.sim.get_body_vel_np(1))
        pushes = fingertip is not None and np.abs(fingertip(now) - fingertip(end)).max() > 1e-6
        return max(velocity, 0.1 * omega) < STILL and not pushes


def _tensor(values: Any) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
