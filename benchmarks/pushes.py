"""Real pushes of a triangle on hardboard and plywood (MLab_EXP): half of each file is fitted, the other half predicted.

The end pose of each push is predicted from its measured start and the finger's track. cgwm's engine and a quasi-static
limit surface (an ellipsoid) are fitted to the same halves by the same robust least squares, from the best of a grid on:
both with the friction of the finger, the engine with the finger's height and, on a patch, face_exponent, the ellipsoid
with a scale of its radius. Errors are medians over the other halves, with the share of bootstrap draws (pushes, by
file) in which the engine is not ahead; then the same for all pushes, each half predicted by fits to the other. Then the
friction of each ground by the measured forces of the halves that are fitted first.

    python benchmarks/pushes.py FOLDER [--out FILE] [--workers N]

FOLDER holds one folder for each file, named by the three supports as x1_x2_x3_y1_y2_y3 [mm] or `patch`, those on
plywood with `wood_` before it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.importers.pushes import Push, read_pushes
from numpy.typing import NDArray
from push_models import (
    CENTER,
    CGWM,
    ELLIPSOID,
    GROUND_FRICTION,
    SAMPLES,
    Model,
    Pushes,
    cgwm_forces,
)
from scipy.signal import savgol_filter
from scipy.stats import t as student

Array = NDArray[Any]

PUBLISHED = {"hardboard": 0.282, "plywood": 0.336}
"""Friction of the ground in the code of the authors, who measured the force of steady sliding."""
UNIT = np.array([1.0, 1.0, 0.6])
"""Errors of x, y [mm] and angle [deg] that count alike in a fit."""
ITERATIONS, DRAWS = 8, 4000
SMOOTHED = 31
"""Samples of the finger's track (0.9 s) over which it is smoothed."""


def read(folder: Path) -> list[Pushes]:
    """Read the pushes of all files."""
    return [_pushes(path.parent.name, read_pushes(path)) for path in sorted(folder.glob("*/*.txt"))]


def _pushes(name: str, pushes: list[Push]) -> Pushes:
    poses = np.stack([_planar(push.object_track) for push in pushes])
    duration = float(np.median([push.finger_track.time_s[-1] - push.finger_track.time_s[0] for push in pushes]))
    sampled = []
    for push in pushes:
        track = push.finger_track
        share = (track.time_s - track.time_s[0]) / (track.time_s[-1] - track.time_s[0])
        assert track.force_n is not None
        # places are rounded to 0.1 mm: the staircase would rub where the finger sticks
        smooth: Any = savgol_filter(track.position_m[:, :2], SMOOTHED, 2, axis=0)
        columns: Any = np.concatenate([smooth, track.force_n[:, :2]], 1)
        sampled.append(np.stack([np.interp(np.linspace(0, 1, SAMPLES), share, column) for column in columns.T], -1))
    each: Any = np.stack(sampled)
    return Pushes(name, poses[:, 0], poses[:, -1], each[..., :2], duration, each[..., 2:])


def _planar(track: Any) -> Array:
    q = track.quat_wxyz
    return np.stack([*track.position_m[:, :2].T, 2 * np.arctan2(q[:, 3], q[:, 0])], -1)


def residuals(found: Array, pushes: Pushes) -> Array:
    """Return the errors of the centre [mm] and of the angle [deg] of end poses (..., n, 3), shape (..., n, 3)."""

    def center(pose: Array) -> Array:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        return pose[..., :2] + np.stack([c * CENTER[0] - s * CENTER[1], s * CENTER[0] + c * CENTER[1]], -1)

    turn = (found[..., 2] - pushes.end[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([1e3 * (center(found) - center(pushes.end)), np.degrees(turn)[..., None]], -1)


def errors(found: Array, pushes: Pushes) -> Array:
    """Return the distances of the centre [mm] and the angles [deg] of end poses (n, 3), shape (n, 2)."""
    each = residuals(found, pushes)
    return np.stack([np.linalg.norm(each[:, :2], axis=1), np.abs(each[:, 2])], -1)


def fitted(model: Model, pushes: Pushes) -> Array:
    """Return the settings (K,) of a model by robust least squares with weak priors, by Gauss-Newton and differences."""
    settings = model.settings(pushes)
    low, high = (np.array([getattr(one, name) for one in settings]) for name in ("low", "high"))
    mean, std = (np.array([getattr(one, name) for one in settings]) for name in ("mean", "std"))

    def scaled(tried: Array) -> Array:
        return residuals(model.ends(pushes, tried), pushes) / UNIT

    def cost(tried: Array, each: Array) -> Array:
        loss = 2 * (np.sqrt(1 + np.square(each).sum(-1)) - 1)
        return loss.sum(-1) + np.square((tried - mean) / std).sum(-1)

    grid = np.array(list(product(*(np.clip(m + np.array([-1.0, 0, 1, 2]) * s, a, b)
                                   for m, s, a, b in zip(mean, std, low, high, strict=True)))))  # fmt: skip
    best = grid[cost(grid, scaled(grid)).argmin()]
    for _ in range(ITERATIONS):
        moves = 0.1 * np.diag(std)
        each = scaled(np.concatenate([best[None], best + moves, best - moves]))
        slopes = (each[1 : len(std) + 1] - each[len(std) + 1 :]) / 0.2
        weight = 1 / np.sqrt(1 + np.square(each[0]).sum(-1))
        normal = np.einsum("anx,bnx,n->ab", slopes, slopes, weight) + np.eye(len(std))
        gradient = np.einsum("anx,nx,n->a", slopes, each[0], weight) + (best - mean) / std
        steps = [np.linalg.solve(normal + k * np.diag(np.diag(normal)), gradient) for k in (0, 0.3, 3)]
        tried = np.clip(best - std * np.array(steps), low, high)
        costs = cost(tried, scaled(tried))
        if costs.min() > cost(best[None], each[:1])[0] - 1e-4:
            break
        best = tried[costs.argmin()]
    return best


def force_ratio(pushes: Pushes, setting: Array) -> Array:
    """Return the friction of the ground (n,) by each push: its measured forces over those of the engine.

    The least-squares factor over the stroke, from the 35th to the 95th hundredth; the engine's forces are proportional
    to its own friction.
    """
    modelled = cgwm_forces(pushes, setting)
    measured = 0.5 * (pushes.force[:, 1:] + pushes.force[:, :-1])
    late = slice(int(0.35 * SAMPLES), int(0.95 * SAMPLES))
    modelled, measured = modelled[:, late], measured[:, late]
    return GROUND_FRICTION * (modelled * measured).sum((1, 2)) / np.square(modelled).sum((1, 2))


def friction_by_ground(files: dict[str, Array]) -> list[dict[str, Any]]:
    """Return friction of each ground, as the mean of its files' medians, with 95 % intervals.

    The files were recorded on different days and places of a board, and differ by more than their pushes tell: their
    standard deviation, the same for all grounds, is estimated from all files.
    """
    grounds: dict[str, list[float]] = {}
    for name, ratios in files.items():
        grounds.setdefault("plywood" if name.startswith("wood_") else "hardboard", []).append(float(np.median(ratios)))
    freedom = sum(len(values) - 1 for values in grounds.values())
    variance = sum(float(np.var(values)) * len(values) for values in grounds.values()) / freedom
    rows = []
    for ground, values in grounds.items():
        half = float(student.ppf(0.975, freedom)) * np.sqrt(variance / len(values))
        mean = float(np.mean(values))
        interval = [round(mean - half, 3), round(mean + half, 3)]
        rows.append({"ground": ground, "friction": round(mean, 3), "interval": interval, "published": PUBLISHED[ground],
                     "files": [round(value, 3) for value in values]})  # fmt: skip
    return rows


def compared(files: list[dict[str, Array]]) -> dict[str, Any]:
    """Return the medians over all pushes, and the share of bootstrap draws in which cgwm is not ahead."""
    rng = np.random.default_rng(0)
    names = list(files[0])
    drawn: dict[str, list[Array]] = {name: [] for name in names}
    for _ in range(DRAWS):
        rows = [rng.integers(len(file["cgwm"]), size=len(file["cgwm"])) for file in files]
        for name in names:
            drawn[name].append(np.median(np.concatenate([f[name][r] for f, r in zip(files, rows, strict=True)]), 0))
    medians = {name: np.median(np.concatenate([file[name] for file in files]), 0).round(2).tolist() for name in names}
    ahead = np.stack(drawn["ellipsoid"]) - np.stack(drawn["cgwm"])
    return {
        **medians,
        "pushes": sum(len(file["cgwm"]) for file in files),
        "ahead_by": np.percentile(ahead, [2.5, 97.5], axis=0).T.round(2).tolist(),
        "not_ahead": (ahead <= 0).mean(0).round(4).tolist(),
    }


@dataclass(frozen=True)
class Half:
    """What fits to one half of a file predict of the other."""

    name: str
    """Folder of the file."""
    errors: dict[str, Array]
    """Errors (n, 2) of the predicted half by model."""
    settings: dict[str, Array]
    """What was fitted, by model."""
    ratios: Array
    """Friction of the ground (n,) by the forces of each fitted push."""


def predicted(pushes: Pushes, fitted_first: int) -> Half:
    """Fit every second push of a file, from the first or the second one on, and predict the others."""
    torch.set_num_threads(1)
    train, test = (pushes.at(slice(first, None, 2)) for first in (fitted_first, 1 - fitted_first))
    found, settings = {"frozen": errors(test.start, test)}, {}
    for model in (ELLIPSOID, CGWM):
        settings[model.name] = fitted(model, train)
        found[model.name] = errors(model.ends(test, settings[model.name][None], faster=1.0)[0], test)
    return Half(pushes.name, found, settings, force_ratio(train, settings["cgwm"]))


def rows_of(halves: list[Half], swapped: list[Half]) -> Iterator[dict[str, Any]]:
    """Yield one row for each file, one for all, the same with each half predicted by the other, one for each ground."""
    for half in halves:
        fits = {f"{name}_settings": values.round(4).tolist() for name, values in half.settings.items()}
        forces = round(float(np.median(half.ratios)), 3)
        yield {"file": half.name, **compared([half.errors]), **fits, "friction_by_forces": forces}
    yield {"file": "all", **compared([half.errors for half in halves])}
    both = [
        {name: np.concatenate([first.errors[name], second.errors[name]]) for name in first.errors}
        for first, second in zip(halves, swapped, strict=True)
    ]
    for half, each in zip(halves, both, strict=True):
        yield {"file": half.name, "halves": "both", **compared([each])}
    yield {"file": "all", "halves": "both", **compared(both)}
    yield from friction_by_ground({half.name: half.ratios for half in halves})


def main() -> None:
    """Print the rows, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, help="file to which the rows are written")
    parser.add_argument("--workers", type=int, default=1, help="processes, each fits half a file at a time")
    arguments = parser.parse_args()
    files = read(arguments.folder)
    with ProcessPoolExecutor(arguments.workers) as pool:
        asked = [[pool.submit(predicted, pushes, first) for pushes in files] for first in (0, 1)]
        halves, swapped = ([one.result() for one in each] for each in asked)
    rows = [json.dumps(row) for row in rows_of(halves, swapped)]
    print("\n".join(rows))
    if arguments.out:
        arguments.out.write_text("".join(f"{row}\n" for row in rows))


if __name__ == "__main__":
    main()
