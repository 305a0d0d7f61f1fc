"""Section with the residual wrench of each segment against time, place, height, heading, speed and spin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...schemas import PHASES
from ..report.page import number, paragraph, section, table, text
from .model_comparison import ComparedModel
from .residual_wrenches import LEAST_WINDOWS, WrenchPoint

UNITS = {"time": "s", "x": "m", "y": "m", "height": "m", "heading": "deg", "speed": "m/s", "spin": "rad/s"}
"""Units of the coordinates, in the order in which they are offered."""
_MISFIT = 6
"""Index of the misfit after the components of force and torque in the world frame; those of the motion follow it."""
_NEARLY = 0.9
"""Share of what the best coordinate explains, from which another one explains nearly as much."""
MOST_POINTS = 1500
"""Maximum number of points per model; more are subsampled."""


def wrench_data(models: Sequence[ComparedModel]) -> dict[str, Any] | None:
    """Return the points of the chart for its script; None if no model has any."""
    if not any(one.wrenches for one in models):
        return None
    known = {name for one in models for point in one.wrenches for name in point.coordinates}
    names = [name for name in UNITS if name in known] + sorted(known - set(UNITS))
    return {
        "coordinates": [{"name": name, "unit": UNITS.get(name, "")} for name in names],
        "first": _first(models, names),
        "models": [[_point(point, names) for point in _thinned(one.wrenches)] for one in models],
    }


def wrench_section(models: Sequence[ComparedModel]) -> str:
    """Return the section with the chart and the coordinates that explain each residual wrench; empty without points."""
    if not any(one.wrenches for one in models):
        return ""
    picks = "".join(
        f'<label>{label} <select data-part="{name}" aria-label="{label}"></select></label>'
        for name, label in (("model", "model"), ("kind", "what"), ("coordinate", "against"), ("phase", "in"))
    )
    words = (
        "Each dot is a segment of the motion; click it to see that moment. Misfit: the residual of its short "
        "prediction in units of the noise. In flight, the chart also shows the constant force over mass, and torque "
        "over inertia, that is missing from the model (± one standard error): along the axes of the world, along the "
        "velocity, where a drag shows, and across it, where a lift shows; in contact the ground "
        "balances every force, so none can be estimated. The black line joins weighted means of four bins with equal "
        "numbers of segments; values beyond the scale are drawn at its edge."
    )
    rows = [
        [text(one.short_name), text(covariate.coordinate), number(100 * covariate.share, 2)]
        for one in models
        for covariate in one.covariates
    ]
    header = ["model", "in flight explained by", "share of the excess over the noise [%]"]
    silent = [one.short_name for one in models if one.wrenches and not one.covariates]
    windows = sum(point.phase == "flight" for point in models[0].wrenches)
    none = ""
    if silent and windows < LEAST_WINDOWS:
        none = f"{windows} windows of flight are too few to decide which coordinate explains the missing force."
    elif silent:
        none = f"In flight no coordinate explains the residual wrench of {', '.join(silent)}: it may be noise."
    return section(
        "What is missing, and where",
        paragraph(words),
        f'<div class="wrench" id="wrench"><div class="controls">{picks}</div>'
        '<div class="scroll"><svg class="chart" data-part="plot" viewBox="0 0 1060 340" role="img" '
        'aria-label="residual wrench"></svg></div>'
        '<div class="phases" data-part="marks"></div>'
        "</div>",
        table(header, rows, numeric=(2,)) if rows else "",
        paragraph(none, "soft") if none else "",
    )


def _first(models: Sequence[ComparedModel], names: Sequence[str]) -> list[int]:
    """Return the indices of the quantity and the coordinate to show first.

    These are the component with the largest excess and the coordinate that explains most, or else the misfit and the
    first coordinate. A force along or across the motion is shown against the speed or the spin, if one of them explains
    nearly as much.
    """
    known = [o for o in models[0].covariates if o.coordinate in names]
    flying = [p for p in models[0].wrenches if p.phase == "flight"]
    sizes = [np.concatenate((p.acceleration / p.std, [np.nan], p.in_motion / p.in_motion_std)) for p in flying]
    excess = np.square(np.array(sizes))
    if not known or not np.isfinite(excess).any():
        return [_MISFIT, 0]
    typical = [np.nanmedian(column) if np.isfinite(column).any() else 0.0 for column in excess.T]
    kind = int(np.argmax(typical))
    nearly = [o.coordinate for o in known if o.share >= _NEARLY * known[0].share]
    moving = next((name for name in nearly if kind > _MISFIT and name in ("speed", "spin")), known[0].coordinate)
    return [kind, names.index(moving)]


def _thinned(points: Sequence[WrenchPoint]) -> Sequence[WrenchPoint]:
    return points[:: -(-len(points) // MOST_POINTS)] if points else points


def _point(point: WrenchPoint, names: Sequence[str]) -> dict[str, Any]:
    known = np.isfinite(point.acceleration) & np.isfinite(point.std)
    moving = list(zip(point.in_motion, point.in_motion_std, strict=True))
    return {
        "e": point.episode,
        "t": round(0.5 * (point.span_s[0] + point.span_s[1]), 4),
        "ph": PHASES.index(point.phase),
        "a": [
            *(round(float(v), 4) if k else None for v, k in zip(point.acceleration, known, strict=True)),
            round(point.misfit, 3),
            *(round(float(v), 4) if np.isfinite(v) else None for v, _ in moving),
        ],
        "s": [
            *(round(float(v), 4) if k else None for v, k in zip(point.std, known, strict=True)),
            0,
            *(round(float(s), 4) if np.isfinite(s) else None for _, s in moving),
        ],
        "c": [round(float(v), 4) if (v := point.coordinates.get(name)) is not None else None for name in names],
    }
