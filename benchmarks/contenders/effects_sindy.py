"""Sparse regression (pysindy's) on smoothed accelerations in flight: Brunton, Proctor & Kutz 2016, with an ensemble.

Tracks are smoothed by parabolas over 0.1 s (Savitzky & Golay), which gives velocities and accelerations; frames that
are near the ground, or in the first 0.13 s, where a hand may be, are left out. Accelerations less gravity and angular
accelerations are regressed on the library's terms by sequentially thresholded least squares (columns of unit norm); a
term is named where most of the regressions on half of the episodes keep it (Fasel & others 2022) and it takes at least
`LEAST_SHARE` of the squares. What acts in contact, and what only the first state shows, it cannot express.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.capture.capture import Capture
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from .effects_base import Named
from .effects_formulas import GRAVITY, MAGNET_M, Array, first_touch

THRESHOLD, KEPT, LEAST_SHARE, REGRESSIONS = 0.05, 0.8, 0.05, 20
_SMOOTHED_S, _SKIPPED_S = 0.1, 0.13
_EQUAL = (
    ("gravity_scale", "buoyancy", "length_scale", "clock_scale"),
    ("gravity_tilt", "frame_tilt"),
    ("com_offset", "marker_offset"),
)
"""Terms that are the same column; the first one is regressed on."""


class SparseRegression:
    """STLSQ on accelerations and angular accelerations."""

    name: str = "sindy"

    def missing(self) -> str | None:
        """Return the package that is needed and not installed, or None."""
        return None if find_spec("pysindy") else "pysindy"

    def names(self, capture: Path) -> Named:
        """Return the terms that the regressions keep."""
        opened = Capture.open(capture, splits=("train",))
        body = opened.manifest.bodies[0]
        shape: Any = body.shape
        half = [shape.sphere.radius_m] * 3 if shape.sphere is not None else list(shape.box.half_extents_m)
        lowest = _corners(half, shape.sphere is not None)
        episodes = [_terms(opened.tracks(name)[body.name], *lowest) for name in opened.episodes("train")]
        linear = _regressed([episode[0] for episode in episodes if episode is not None])
        turning = _regressed([episode[1] for episode in episodes if episode is not None and episode[1]])
        names = [*linear, *turning]
        aliases = tuple(next((group for group in _EQUAL if name in group), (name,)) for name in names)
        return Named(named=tuple(names), aliases=aliases, details={"shares": {**linear, **turning}})


def _corners(half: list[float], ball: bool) -> tuple[Array, float]:
    """Return the points that may touch (n, 3), body frame, and their radius [m]."""
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (np.zeros((1, 3)), half[0]) if ball else (signs * np.array(half), 0.0)


Terms = dict[str, Array]


def _terms(track: Any, corners: Array, radius: float) -> tuple[Terms, Terms] | None:
    """Return the columns of an episode's flight: of accelerations, and of angular ones, `target` among them."""
    times, places = np.asarray(track.time_s), np.asarray(track.position_m)
    gap = float(np.median(np.diff(times)))
    window = 2 * max(round(_SMOOTHED_S / gap / 2), 2) + 1
    if len(times) < window + 4:
        return None
    turn = None if track.quat_wxyz is None else Rotation.from_quat(np.asarray(track.quat_wxyz), scalar_first=True)
    low = places[:, 2] - radius
    if turn is not None:
        low = (places[:, None] + np.einsum("tij,nj->tni", turn.as_matrix(), corners))[..., 2].min(1) - radius
    end = first_touch(low) - window // 2
    begin = int(np.searchsorted(times, times[0] + _SKIPPED_S)) + window // 2
    if end - begin < 4:
        return None
    moving: list[Array] = [
        np.asarray(savgol_filter(places, window, 2 if order else 3, deriv=order, delta=gap, axis=0))[begin:end]
        for order in range(3)
    ]
    place, velocity, acceleration = moving
    fast = np.linalg.norm(velocity, axis=1, keepdims=True)
    up = np.tile([0.0, 0.0, 1.0], (len(place), 1))
    linear = {
        "target": acceleration + GRAVITY * up,
        "linear_drag": -velocity,
        "quadratic_drag": -fast * velocity,
        "gravity_scale": up,
        "gravity_tilt": np.broadcast_to(np.eye(3)[:, :2], (len(place), 3, 2)),
        "ground_magnet": -np.exp(-low[begin:end, None].clip(0) / MAGNET_M) * up,
    }
    if turn is None:
        return linear, {}
    spins = (turn[1:] * turn[:-1].inv()).as_rotvec() / np.diff(times)[:, None]
    spins = np.vstack((spins, spins[-1:]))
    omega = np.asarray(savgol_filter(spins, window, 2, axis=0))[begin:end]
    alpha = np.asarray(savgol_filter(spins, window, 2, deriv=1, delta=gap, axis=0))[begin:end]
    linear["magnus_lift"] = np.cross(omega, velocity)
    axes = turn[begin:end].as_matrix()
    lever = [np.cross(alpha, d) + np.cross(omega, np.cross(omega, d)) for d in np.moveaxis(axes, 2, 0)]
    linear["com_offset"] = np.stack(lever, -1)
    return linear, {"target": alpha, "spin_damping": -omega}


def _regressed(episodes: list[Terms]) -> dict[str, float]:
    """Return the terms that most regressions keep, with the share of the squares that each takes."""
    if len(episodes) < 2:
        return {}
    sindy: Any = import_module("pysindy")
    names = [name for name in episodes[0] if name != "target"]
    rng, kept = np.random.default_rng(0), dict.fromkeys(names, 0)
    for _ in range(REGRESSIONS):
        some = rng.choice(len(episodes), (len(episodes) + 1) // 2, replace=False)
        columns, owners, target = _stacked([episodes[k] for k in some], names)
        scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        size = float(np.linalg.norm(target)) or 1.0
        optimizer = sindy.STLSQ(threshold=THRESHOLD, alpha=1e-3, max_iter=20)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that nothing is left is an answer
            optimizer.fit(columns / scale, target[:, None] / size)
        sizes = np.abs(np.ravel(optimizer.coef_))
        for name in names:
            kept[name] += bool(sizes[owners[name]].max() > 0)
    chosen = [name for name in names if kept[name] >= KEPT * REGRESSIONS]
    shares = {name: _share(episodes, chosen, name) for name in chosen}
    return {name: round(share, 3) for name, share in shares.items() if share >= LEAST_SHARE}


def _share(episodes: list[Terms], chosen: list[str], name: str) -> float:
    """Return the share of the squares that one term takes beside the others."""

    def left(names: list[str]) -> float:
        columns, _, target = _stacked(episodes, names)
        if not names:
            return float(target @ target)
        rest = target - columns @ np.linalg.lstsq(columns, target, rcond=1e-8)[0]
        return float(rest @ rest)

    return (left([other for other in chosen if other != name]) - left(chosen)) / max(left([]), 1e-12)


def _stacked(episodes: list[Terms], names: list[str]) -> tuple[Array, dict[str, slice], Array]:
    """Return columns (n, k), the slice of each term, and the target (n,), of all episodes and axes."""
    target = np.concatenate([episode["target"].ravel() for episode in episodes])
    columns, owners, place = [], {}, 0
    for name in names:
        own = np.vstack([episode[name].reshape(episode["target"].size, -1) for episode in episodes])
        columns.append(own)
        owners[name] = slice(place, place + own.shape[1])
        place += own.shape[1]
    return (np.hstack(columns) if columns else np.zeros((len(target), 0))), owners, target
