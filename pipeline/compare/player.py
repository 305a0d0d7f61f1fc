"""Data of the player of a comparison: motions, errors and phases by episode, as numbers for its script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...datasets.models.model import Model
from ...schemas import PHASES
from ..evaluate.prediction import MODEL, EpisodePrediction
from ..geometry.directions import fibonacci_directions
from ..report.page import read_asset
from .model_comparison import ComparedModel

Array = NDArray[np.float64]

REPLAY_STYLE = read_asset(__name__, "player.css")
"""Style rules of the page of a comparison, in addition to those of every page."""
REPLAY_SCRIPT = read_asset(__name__, "player.js")
"""Script of the player, the sortable tables and the chart of residual wrenches."""
LENGTH_UNIT_M = 1e-4
"""Resolution of positions in the page [m]; they are written as integers."""
QUAT_UNIT = 1e-4
"""Resolution of quaternions in the page; they are written as integers."""
DIRECTIONS = 96
"""Number of directions in which the outermost point of a body is computed."""
MOST_EDGES = 40
"""Maximum number of edges that are drawn; a body with more counts as round and is drawn as an outline with axes."""
MOST_NUMBERS = 900_000
"""Maximum number of values in all episodes of the player; a value takes about five bytes of the page."""


@dataclass(frozen=True)
class Replay:
    """The data of the player."""

    data: dict[str, Any]
    """Models, bodies, ground and episodes, as the script reads them."""
    left_out: tuple[str, ...]
    """Names of the episodes that were omitted to keep the page small."""


def replay_of(models: Sequence[ComparedModel], first: Sequence[str]) -> Replay:
    """Return the player's data.

    Args:
        models: The models, in order; the measured motions are those in the evaluation of the first one.
        first: Episodes in the order in which they are included, until `MOST_NUMBERS` is reached.
    """
    predictions = [{e.prediction.episode: e.prediction for e in one.evaluation.episodes} for one in models]
    chosen, left_out, numbers = [], [], 0
    for name in first:
        known = [found[name] for found in predictions if name in found]
        size = sum(len(p.time_s) * len(p.bodies) * 12 for p in known) + len(known[0].grid_s) * 7
        if chosen and numbers + size > MOST_NUMBERS:
            left_out.append(name)
            continue
        numbers += size
        chosen.append(name)
    order = [name for name in predictions[0] if name in set(chosen)]
    file = models[0].model.file
    ground = file.ground
    data = {
        "models": [one.short_name for one in models],
        "phases": list(PHASES),
        "bodies": {body.name: _body(models[0].model, body.name, body.motion) for body in file.bodies},
        "ground": None if ground is None else {"normal": list(ground.normal), "offset": ground.offset_m},
        "episodes": [_episode(name, models, predictions) for name in order],
    }
    return Replay(data, tuple(left_out))


def _episode(
    name: str, models: Sequence[ComparedModel], predictions: Sequence[Mapping[str, EpisodePrediction]]
) -> dict[str, Any]:
    one = next(found[name] for found in predictions if name in found)
    file = models[0].model.file
    up = _up(models[0].model)
    along, across, bearing = _view(one, up)
    others = [k for k, body in enumerate(file.bodies) if k not in one.free]
    return {
        "name": name,
        "t": _decimals(one.time_s - one.time_s[0], 5),
        "warm": round(one.warmup_end_s - float(one.time_s[0]), 5),
        "free": list(one.bodies),
        "axes": [_decimals(axis, 6) for axis in (along, across, up)],
        "bearing": round(bearing, 1),
        "p": _lengths(np.where(one.seen[..., None], one.position_m, np.nan)),
        "q": _quats(np.where(one.turned[..., None], one.quat_wxyz, np.nan)),
        "others": {
            file.bodies[k].name: {
                "p": _lengths(one.motions[MODEL].position_m[one.rows][:, [k]]),
                "q": _quats(one.motions[MODEL].quat_wxyz[one.rows][:, [k]]),
            }
            for k in others
        },
        "models": [
            _model(found[name], compared) if name in found else None
            for found, compared in zip(predictions, models, strict=True)
        ],
    }


def _model(one: EpisodePrediction, compared: ComparedModel) -> dict[str, Any]:
    position, quat = one.predicted()
    short = compared.short.get(one.episode)
    found: dict[str, Any] = {
        "p": _lengths(position),
        "q": _quats(quat),
        "move": _mean(one.translation_error_m() * 1e3, 3),
        "turn": _mean(one.rotation_error_deg(), 3) if one.turned.any() else None,
        "z": None,
        "phase": None,
    }
    if short is not None:
        at = np.abs(one.time_s[:, None] - short.time_s).argmin(0)
        z = np.full(len(one.time_s), np.nan)
        z[at] = short.largest()
        phase = np.full(len(one.time_s), -1)
        phase[at] = short.phase
        found |= {"z": _decimals(z, 2), "phase": phase.tolist()}
    return found


def _body(model: Model, name: str, motion: str) -> dict[str, Any]:
    """Return the outermost points (P, 3) of a body in its frame, and its edges if there are few."""
    spheres = model.collision[name]
    radii = np.asarray(spheres.scales) * model.body(name).radius_factor
    directions = fibonacci_directions(DIRECTIONS)
    directions = np.concatenate((directions, _CORNERS))
    reach = spheres.means @ directions.T + radii[:, None]
    outermost = reach.argmax(0)
    shape = model.body(name).shape
    if shape is not None and shape.box is not None:
        points = _CORNERS * np.sqrt(3) * np.asarray(shape.box.half_extents_m)
    else:
        points = spheres.means[outermost] + radii[outermost, None] * directions
    edges = _edges(points)
    return {
        "motion": motion,
        "points": _lengths(points),
        "edges": edges if 0 < len(edges) <= MOST_EDGES else [],
        "size": _rounded(float(np.linalg.norm(np.ptp(points, axis=0)) / 2) / LENGTH_UNIT_M),
    }


_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float64) / np.sqrt(3)


def _edges(points: Array) -> list[list[int]]:
    """Return the edges of the convex hull as pairs of points, without the diagonals of its flat sides."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return []
    sides: dict[tuple[int, int], list[Array]] = {}
    for triangle, plane in zip(hull.simplices, hull.equations, strict=True):
        for k in range(3):
            a, b = sorted((int(triangle[k]), int(triangle[(k + 1) % 3])))
            sides.setdefault((a, b), []).append(plane[:3])
    return [[a, b] for (a, b), normals in sides.items() if len(normals) == 2 and normals[0] @ normals[1] < 0.99]


def _up(model: Model) -> Array:
    ground, gravity = model.file.ground, np.asarray(model.file.gravity_m_s2)
    size = float(np.linalg.norm(gravity))
    if ground is not None:
        up = np.asarray(ground.normal, np.float64)
    else:
        up = -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
    return up / np.linalg.norm(up)


def _view(one: EpisodePrediction, up: Array) -> tuple[Array, Array, float]:
    """Return the horizontal principal direction of the motion, the direction across it, and its bearing [deg].

    The bearing is measured from the world's x axis, or from the y axis if x points up.
    """
    reference = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    x = reference - up * (up @ reference)
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    points = one.position_m[one.seen]
    flat = np.stack([points @ x, points @ y], 1).astype(np.float64)
    flat = flat - flat.mean(0)
    _, vectors = np.linalg.eigh(flat.T @ flat)
    main = vectors[:, -1]
    travel = flat[-1] - flat[0]
    main = main if main @ travel >= 0 else -main
    along = (main[0] * x + main[1] * y).astype(np.float64)
    across = np.cross(up, along).astype(np.float64)
    return along, across, float(np.degrees(np.arctan2(main[1], main[0])))


def _mean(values: Array, decimals: int) -> list[float | None]:
    """Return the mean over bodies (T,) of values (T, nf); None where no value is known."""
    known = np.isfinite(values)
    count = known.sum(1)
    total = np.where(known, values, 0.0).sum(1)
    return _decimals(np.where(count > 0, total / np.maximum(count, 1), np.nan), decimals)


def _decimals(values: Array, decimals: int) -> list[float | None]:
    return [round(float(value), decimals) if np.isfinite(value) else None for value in values]


def _rounded(value: float) -> int | None:
    return round(value) if np.isfinite(value) else None


def _lengths(values: Array) -> list[int | None]:
    return [_rounded(float(value)) for value in np.asarray(values).ravel() / LENGTH_UNIT_M]


def _quats(values: Array) -> list[int | None]:
    return [_rounded(float(value)) for value in np.asarray(values).ravel() / QUAT_UNIT]
