"""Bundle adjustment of a model whose camera stands before a turntable."""

from __future__ import annotations

from collections.abc import Mapping as Map
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ...optimization.least_squares import Policy, descend
from ...optimization.problem import Box, Point, Problem, Rows
from ..bundle import NormalEquations, ReducedEquations, all_errors_px, linearized, moved_lens
from ..camera_models import LENS_PARAMETERS
from ..reconstruction import Array, SfmModel
from .motion import TurntableMotion

_POLICY = Policy(
    iterations=160, damping=1e-3, up=8.0, least_damping=1e-9, most_damping=1e6, relative=1e-5, linearise_end=False
)


def adjusted(
    model: SfmModel,
    motion: TurntableMotion,
    models: Map[str, str],
    loss_px: float,
    focals: Map[str, tuple[float, float]],
    steps: int = 40,
) -> tuple[SfmModel, TurntableMotion]:
    """Adjust a turntable's motion, points and intrinsics to the observations, under a Cauchy loss.

    Args:
        model: The model, with the axis of the turntable along z. Its poses are replaced by those of the motion.
        motion: The motion to start from.
        models: COLMAP's camera model of each camera whose intrinsics are estimated.
        loss_px: Scale of the loss [px].
        focals: Focal length [px] and its weight [1/px^2, in units of squared residuals in pixels] of cameras for which
            it is known otherwise, too.
        steps: Most steps.
    """
    problem = _Adjustment(model, motion, models, loss_px, focals)
    return problem.model_at(descend(problem, problem.start(), replace(_POLICY, steps=steps)).point)


class _Adjustment(Problem):
    """One group and one item, whose states are the points of a model and its motion.

    The parameters are the sums of the steps of the motion's numbers (see `TurntableMotion.design`), which move it along
    its rotations, and the changes of the intrinsics.
    """

    def __init__(
        self,
        model: SfmModel,
        motion: TurntableMotion,
        models: Map[str, str],
        loss_px: float,
        focals: Map[str, tuple[float, float]],
    ) -> None:
        self._model, self._motion, self._models, self._loss_px = model, motion, models, loss_px
        self._lenses, count = {}, motion.numbers
        for camera, name in models.items():
            self._lenses[camera] = slice(count, count + LENS_PARAMETERS[name])
            count += LENS_PARAMETERS[name]
        self.owner = torch.zeros(1, dtype=torch.long)
        centre, information = torch.zeros(2, 1, count, dtype=torch.float64)
        for camera, (focal_px, weight) in focals.items():
            column = self._lenses[camera].start
            centre[0, column], information[0, column] = focal_px - model.cameras[camera].fx, weight
        self.box = replace(Box.unbounded(centre), centre=centre, information=information)

    def start(self) -> Point:
        """Return where the adjustment begins."""
        points = torch.as_tensor(self._model.points, dtype=torch.float64)
        return Point(values=torch.zeros_like(self.box.low), states=(points[None], *_states(self._motion)))

    def model_at(self, point: Point) -> tuple[SfmModel, TurntableMotion]:
        """Return the model and the motion at a point."""
        values, (points, standing, angles) = point.values[0].numpy(), (state[0].numpy() for state in point.states)
        names = [image for ring in self._motion.rings for image in ring]
        turned = {image: float(angle) for image, angle in zip(names, angles, strict=True)}
        motion = TurntableMotion(self._motion.rings, tuple(standing), turned)
        cameras = dict(self._model.cameras)
        for camera, columns in self._lenses.items():
            cameras[camera] = moved_lens(cameras[camera], self._models[camera], values[columns])
        return motion.placed(replace(self._model, cameras=cameras, points=points)), motion

    def costs(self, point: Point, rows: Rows) -> Tensor:
        """Return the Cauchy loss of all observations [px^2], infinite where a point is behind a camera that sees it."""
        del rows
        model, _ = self.model_at(point)
        return self._cost(model, all_errors_px(model))

    def linearised(self, point: Point, rows: Rows) -> _PointsApart:
        """Return the normal equations, with the points apart."""
        del rows
        model, motion = self.model_at(point)
        whole = linearized(model, self._models, self._loss_px)
        design = motion.design(list(model.T_cam_world), self.box.low.shape[1] - motion.numbers)
        return _PointsApart(whole=whole, design=design, cost=self._cost(model, whole.residuals_px))

    def moved(self, point: Point, values: Tensor, step: Tensor, rows: Rows) -> tuple[Tensor, ...]:
        """Return the points and the motion after a step."""
        del rows
        _, motion = self.model_at(point)
        along = (values - point.values)[0, : motion.numbers].numpy()
        return (point.states[0] + step.unflatten(1, (-1, 3)), *_states(motion.moved(along)))

    def _cost(self, model: SfmModel, lengths: Array) -> Tensor:
        """Return the loss of errors (observation,) of a model."""
        loss = float(self._loss_px**2 * np.log1p((lengths / self._loss_px) ** 2).sum())
        for image, pose in model.T_cam_world.items():
            depth = model.points[model.observations[image][1]] @ pose[2, :3] + pose[2, 3]
            if (depth <= 0).any():
                loss = np.inf
        return torch.tensor([loss], dtype=torch.float64)


def _states(motion: TurntableMotion) -> tuple[Tensor, Tensor]:
    """Return the poses (1, ring, 4, 4) of a motion, and the angles (1, photo) of the photos of its rings in turn."""
    angles = [motion.angles[image] for ring in motion.rings for image in ring]
    return torch.as_tensor(np.array(motion.T_cam_axis))[None], torch.tensor([angles], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class _PointsApart:
    """Normal equations whose states are points, each of them coupled to the photos that see it only."""

    whole: NormalEquations
    """Of poses, intrinsics and points."""
    design: Array
    """How poses and intrinsics change with the parameters, shape (n, P)."""
    cost: Tensor
    """Cost, shape (1,)."""

    def at(self, items: Tensor) -> _PointsApart:
        """Return the equations of the one item."""
        del items
        return self

    def put(self, items: Tensor, other: _PointsApart) -> _PointsApart:
        """Return the equations that replace those of the one item."""
        del self, items
        return other

    def finite(self) -> Tensor:
        """Return whether the gradient is finite, shape (1,)."""
        whole = self.whole
        return torch.tensor([bool(np.isfinite(whole.right).all() and np.isfinite(whole.points_right).all())])

    def eliminated(self, damping: Tensor | None = None, unit: Tensor | None = None) -> _WithoutPoints:
        """Eliminate the points, damped in units of the diagonal of their blocks."""
        del unit
        return _WithoutPoints(self.whole.reduced(0.0 if damping is None else float(damping)), self.design)


@dataclass(frozen=True)
class _WithoutPoints:
    """Normal equations of a turntable's motion and intrinsics, points eliminated."""

    reduced: ReducedEquations
    """Of poses and intrinsics."""
    design: Array
    """How these change with the parameters, shape (n, P)."""

    @cached_property
    def information(self) -> Tensor:
        """Information on the parameters, shape (1, P, P)."""
        return torch.as_tensor(self.design.T @ self.reduced.matrix @ self.design)[None]

    @property
    def score(self) -> Tensor:
        """Negative gradient by the parameters, shape (1, P)."""
        return torch.as_tensor(self.design.T @ self.reduced.right)[None]

    def following(self, change: Tensor, share: float = 1.0) -> Tensor:
        """Return the step (1, 3 points) of the points for changes (1, P), a share of the whole step."""
        step = self.reduced.points_step(self.design @ change[0].numpy(), share)
        return torch.as_tensor(step.reshape(1, -1))
