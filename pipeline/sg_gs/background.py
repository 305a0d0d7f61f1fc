"""Fit of the background spheres, and refinement of the camera poses by such a fit."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import Any

from ...datasets.capture.sparse_points import POINTS_NAME
from ...schemas import InputDataError
from ..geometry.spheres import Spheres
from .appearance.colors import mean_colors
from .appearance.initialization import scene_seeds, shows_bodies, to_spheres
from .appearance.losses import behind, scene_loss
from .appearance.mcmc import fit_adaptively
from .appearance.optimize import Rates, Trainable, descend, detached, thinned
from .context import Stage
from .photos.camera_refinement import Motions, motion_record, moved_for_good

_START_SHARE = 0.3
"""Number of background spheres at the start of a fit, as a share of the budget."""
_POSE_STEPS = 2.0
"""Number of steps that refine the camera poses without a budget of spheres, in units of the setting `iterations`."""


def fit_background(stage: Stage, bodies: list[Spheres]) -> Spheres:
    """Fit the background spheres behind the visual spheres of the bodies (world frame), which stay fixed."""
    started = time.perf_counter()
    standing = Spheres.joined(bodies) if bodies else None
    spheres, record = _background_spheres(stage, standing, "background", None)
    seconds = round(time.perf_counter() - started, 2)
    stage.record["scene"] = {"spheres": len(spheres), **record, "seconds": seconds}
    return spheres


def refine_poses(stage: Stage) -> None:
    """Refine the camera poses by a fit of the background, whose spheres are then discarded."""
    started = time.perf_counter()
    motions = Motions(stage.train, stage.spread)
    _background_spheres(stage, None, "camera poses", motions)
    found = motions.found(stage.train)
    stage.train = [moved_for_good(view, found[view.name]) for view in stage.train]
    stage.record["camera_poses"] = motion_record(found) | {"seconds": round(time.perf_counter() - started, 2)}


def _background_spheres(
    stage: Stage, bodies: Spheres | None, what: str, motions: Motions | None
) -> tuple[Spheres, dict[str, Any]]:
    """Return the fitted background spheres, whose number grows where a budget is set, and a record of the fit."""
    config = stage.config
    loss = scene_loss(bodies, stage.exposures, motions)
    slot = stage.slot(what)
    if config.spheres is None:
        start = _background_seeds(stage, config.max_scene_spheres, bodies)
        trainable = Trainable(start, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
        steps = stage.steps(0.75 if motions is None else _POSE_STEPS)
        losses = descend(trainable, stage.train, loss, steps, config.seed, what, 0.001, stage.exposures, motions, slot)
        return detached(trainable.spheres()), {"loss": thinned(losses)}
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


def _background_seeds(stage: Stage, count: int, bodies: Spheres | None) -> Spheres:
    """Return the initial background spheres: on the ground, on SfM points or depth maps, and far away."""
    if stage.points is None and stage.ground is None:
        where = "lies on a shell far away" if shows_bodies(stage.train) else "starts from random points"
        warning = f"No {POINTS_NAME} and no ground: the background {where}."
        stage.warnings += [warning] if warning not in stage.warnings else []
    centers, scales = scene_seeds(stage.train, stage.ground, stage.points, count, stage.config.seed)
    if len(scales) == 0:
        raise InputDataError(
            f"{stage.capture.root}: the photos show no background to fit.",
            "photos in which some pixels belong to no body.",
            "check that the masks are white on the bodies alone.",
        )
    spheres = to_spheres(centers, scales, 0.9 if stage.config.spheres is None else 0.5, stage.device)
    colors = mean_colors(behind(bodies, spheres), [stage.exposures.even(view) for view in stage.train])
    return replace(spheres, colors=colors if bodies is None else colors[len(bodies) :])
