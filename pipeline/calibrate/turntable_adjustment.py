"""Bundle adjustment of a model whose camera stands before a turntable."""

from __future__ import annotations

from collections.abc import Mapping as Map
from dataclasses import replace

import numpy as np

from .bundle import POSE, NormalEquations, errors_px, linearized, moved_lens
from .camera_models import LENS_PARAMETERS
from .reconstruction import SfmModel
from .turntable_motion import TurntableMotion

_FIRST_DAMPING, _MOST_DAMPING, _LEAST_DAMPING = 1e-3, 1e6, 1e-9
_UP, _DOWN = 8.0, 5.0
_DONE = 1e-5
"""Relative decrease of the cost below which the adjustment ends."""


def adjusted(
    model: SfmModel,
    motion: TurntableMotion,
    models: Map[str, str],
    loss_px: float,
    focals: Map[str, tuple[float, float]],
    steps: int = 40,
) -> tuple[SfmModel, TurntableMotion]:
    """Adjust a turntable's motion, points and intrinsics to the observations, under a Cauchy loss.

    Damped Gauss-Newton; the points are eliminated.

    Args:
        model: The model, with the axis of the turntable along z. Its poses are replaced by those of the motion.
        motion: The motion to start from.
        models: COLMAP's camera model of each camera whose intrinsics are estimated.
        loss_px: Scale of the loss [px].
        focals: Focal length [px] and its weight [1/px^2, in units of squared residuals in pixels] of cameras for which
            it is known otherwise, too.
        steps: Most steps.
    """
    model = motion.placed(model)
    damping, cost = _FIRST_DAMPING, _cost(model, loss_px, focals)
    for _ in range(steps):
        equations = _with_focals(linearized(model, models, loss_px), model, focals)
        while damping < _MOST_DAMPING:
            tried, moved = _stepped(model, motion, models, equations, damping)
            lower = _cost(tried, loss_px, focals)
            if lower < cost:
                break
            damping *= _UP
        else:
            break
        gain = (cost - lower) / cost
        model, motion, cost, damping = tried, moved, lower, max(damping / _DOWN, _LEAST_DAMPING)
        if gain < _DONE:
            break
    return model, motion


def _stepped(
    model: SfmModel, motion: TurntableMotion, models: Map[str, str], equations: NormalEquations, damping: float
) -> tuple[SfmModel, TurntableMotion]:
    names = list(model.T_cam_world)
    lenses = len(equations.right) - POSE * len(names)
    design = motion.design(names, lenses)
    reduced = equations.reduced(damping)
    free = design.T @ reduced.matrix @ design
    diagonal = np.einsum("ij,ij->j", design, equations.matrix @ design)
    free[np.diag_indices_from(free)] += damping * diagonal + np.finfo(float).tiny
    step = np.asarray(np.linalg.lstsq(free, design.T @ reduced.right)[0], np.float64)
    along = design @ step
    moved = motion.moved(step)
    cameras = dict(model.cameras)
    for camera, first in equations.columns.items():
        lens = along[first : first + LENS_PARAMETERS[models[camera]]]
        cameras[camera] = moved_lens(cameras[camera], models[camera], lens)
    points = model.points + reduced.points_step(along)
    return moved.placed(replace(model, cameras=cameras, points=points)), moved


def _with_focals(equations: NormalEquations, model: SfmModel, focals: Map[str, tuple[float, float]]) -> NormalEquations:
    for camera, (focal, weight) in focals.items():
        column = equations.columns[camera]
        equations.matrix[column, column] += weight
        equations.right[column] += weight * (focal - model.cameras[camera].fx)
    return equations


def _cost(model: SfmModel, loss_px: float, focals: Map[str, tuple[float, float]]) -> float:
    """Return the Cauchy loss of all observations [px^2], infinite where a point is behind a camera that sees it."""
    total = sum(weight * (model.cameras[camera].fx - focal) ** 2 for camera, (focal, weight) in focals.items())
    for image, pose in model.T_cam_world.items():
        depth = model.points[model.observations[image][1]] @ pose[2, :3] + pose[2, 3]
        if (depth <= 0).any():
            return np.inf
        total += float(loss_px**2 * np.log1p((errors_px(model, image) / loss_px) ** 2).sum())
    return float(total)
