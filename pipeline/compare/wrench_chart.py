"""The section with what is missing, segment by segment, against time, place, height, heading, speed and spin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...schemas import PHASES
from ..compared import ComparedModel
from ..wrench_points import LEAST_WINDOWS, WrenchPoint
from .page import number, paragraph, section, table, text

UNITS = {"time": "s", "x": "m", "y": "m", "height": "m", "heading": "deg", "speed": "m/s", "spin": "rad/s"}
_MISFIT = 6
"""Place of the misfit after force and torque."""
MOST_POINTS = 1500
"""Of one model; of more, every so manyth is drawn."""


def wrench_data(models: Sequence[ComparedModel]) -> dict[str, Any] | None:
    """Return the points of the chart for its script; None where no model has any."""
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
    """Return the section with the chart and what orders the residual wrench of each model; empty without points."""
    if not any(one.wrenches for one in models):
        return ""
    picks = "".join(
        f'<label>{label} <select data-part="{name}" aria-label="{label}"></select></label>'
        for name, label in (("model", "model"), ("kind", "what"), ("coordinate", "against"), ("phase", "in"))
    )
    words = (
        "Each dot is a piece of the motion and leads to its moment. Misfit: the residual of its short prediction in "
        "units of the noise. In flight also the constant force over mass, and torque over inertia, that it would need "
        "on top of the model (one standard error each way; world frame); in contact the ground answers every force, so "
        "that none is told. The black line joins weighted means of four equally filled bins; what exceeds the scale "
        "runs along its rim."
    )
    rows = [
        [text(one.short_name), text(organiser.coordinate), number(100 * organiser.share, 2)]
        for one in models
        for organiser in one.organisers
    ]
    header = ["model", "in flight ordered by", "share of the excess over the noise [%]"]
    silent = [one.short_name for one in models if one.wrenches and not one.organisers]
    windows = sum(point.phase == "flight" for point in models[0].wrenches)
    none = ""
    if silent and windows < LEAST_WINDOWS:
        none = f"{windows} windows of flight are too few to tell what orders the missing force."
    elif silent:
        none = f"In flight nothing orders what is missing in {', '.join(silent)}: it is noise, or no pattern of these."
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
    """Return the quantity and the coordinate that are shown first: the force that is most ordered, or the misfit."""
    ordered = [o.coordinate for o in models[0].organisers if o.coordinate in names]
    excess = np.array([np.square(p.acceleration / p.std) for p in models[0].wrenches if p.phase == "flight"])
    if not ordered or not np.isfinite(excess).any():
        return [_MISFIT, 0]
    typical = [np.nanmedian(column) if np.isfinite(column).any() else 0.0 for column in excess.T]
    return [int(np.argmax(typical)), names.index(ordered[0])]


def _thinned(points: Sequence[WrenchPoint]) -> Sequence[WrenchPoint]:
    return points[:: -(-len(points) // MOST_POINTS)] if points else points


def _point(point: WrenchPoint, names: Sequence[str]) -> dict[str, Any]:
    known = np.isfinite(point.acceleration) & np.isfinite(point.std)
    return {
        "e": point.episode,
        "t": round(0.5 * (point.span_s[0] + point.span_s[1]), 4),
        "ph": PHASES.index(point.phase),
        "a": [
            *(round(float(v), 4) if k else None for v, k in zip(point.acceleration, known, strict=True)),
            round(point.misfit, 3),
        ],
        "s": [*(round(float(v), 4) if k else None for v, k in zip(point.std, known, strict=True)), 0],
        "c": [round(float(v), 4) if (v := point.coordinates.get(name)) is not None else None for name in names],
    }
