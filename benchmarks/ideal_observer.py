"""What an observer could name in real-like captures who knows the true errors: the limit of any rule.

    python benchmarks/missing_effects.py run --stage development --each 6 --nulls 3 --contenders cgwm
    python benchmarks/ideal_observer.py --stage development [--only flight]

For each capture with one effect of flight or measurement that `missing_effects.py` has made, the true effect, as large
as it is, is projected on what whole flights show: generalised least squares with the true covariance of the errors
(white, slow, bursts at their true times) and the true variances of tilts and scales, states free. `chi2` is its square
in standard errors, what a test of this one effect expects beside chance; `apart` is what the best effect of another
class leaves of it. Smoothing is left out, as it can be undone. A magnet has another law than cgwm's, and is left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.diagnose.stage import library_of, prepared_world
from cgwm.pipeline.fit import fit
from cgwm.pipeline.segments.candidates import acts_in, admissible, variants_of
from cgwm.pipeline.segments.linearization import derivatives
from cgwm.pipeline.segments.prepare import whole_flights
from cgwm.pipeline.segments.segment_states import fit_states
from cgwm.pipeline.segments.segments import Segments
from cgwm.pipeline.trajectories.innovations import WHITE
from real_like import STAGES
from real_like.errors import Errors, slow_correlation
from real_like.score import EQUIVALENT, rate
from store import ROOT

LEAST_FRAMES = 6
MEASURED = 0.04
"""A direction of parameters counts where its information times the variance of the prior is above this."""
LIMITS = (16.0, 25.0)
"""Squares of 4 and of 5 standard errors: a test of 15 candidates at 0.002 asks for 3.8."""
BINS = ((0.0, 17.0), (17.0, np.inf))
"""Ratios of the effect to the slow error: small and large ones."""

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Seen:
    """The information of whole flights about all candidates."""

    names: list[str]
    """Name of the effect of each parameter (P)."""
    numbers: list[str]
    """Name of each parameter in its effect (P)."""
    width: Array
    """Its usual size (P)."""
    information: Array
    """With states, tilts and scales projected out, (P, P)."""


def seen(model: Path, capture: Path, truth: dict[str, Any]) -> Seen:
    """Return what the training flights of a capture show under the true errors."""
    world, prepared = prepared_world(read_model(model), Capture.open(capture, splits=("train",)), "train")
    kept, _ = admissible(world, library_of(()), prepared.has_orientation)
    variants = [v for v in variants_of(kept, world.gravity[0, :1]) if acts_in(v, "flight")]
    every = whole_flights(prepared.flight.items) if prepared.flight is not None else []
    items = [item for item in every if item.last - item.first + 1 >= LEAST_FRAMES]
    fitted = fit_states(prepared.segments("flight", world, items))
    plain = Segments.of("flight", world, prepared.observations, items, prepared.noise, WHITE)
    plain = plain.with_state(fitted.observations.state)
    parameters, _, jacobian = derivatives(plain, world, variants)
    slopes = torch.nan_to_num(jacobian).numpy().astype(np.float64)
    owner = {name: kept[v.place].effect.name for v in variants for name in v.parameters}
    names = [owner.get(p.name, p.name) for p in parameters]
    numbers = [p.name.partition(".")[2] for p in parameters]
    errors, episodes = _errors(truth), truth["episodes"]
    tilts = [names.index("frame_tilt") + k for k in range(2)] if errors.tilt_rad else []
    scales = [names.index("length_scale")] if errors.scale else []
    kinds = [(("tilt", prepared.names[item.episode]), tilts) for item in items]
    owners = [[kind, (("scale", episodes[kind[0][1]]["session"]), scales)] for kind in kinds]
    places = {
        key: (k, columns) for k, (key, columns) in enumerate({key: c for own in owners for key, c in own}.items())
    }
    size, starts = len(parameters), _starts(places, len(parameters))
    total = np.zeros((starts["end"], starts["end"]))
    for k, item in enumerate(items):
        rows = _whitened(plain, slopes, k, errors, episodes[prepared.names[item.episode]]["bursts_s"])
        own, states = rows[:, :size], rows[:, size:]
        every_column = np.zeros((len(rows), starts["end"]))
        every_column[:, :size] = own
        for key, columns in owners[k]:
            every_column[:, starts[key] : starts[key] + len(columns)] = own[:, columns]
        basis, s, _ = np.linalg.svd(states / np.linalg.norm(states, axis=0).clip(1e-12), full_matrices=False)
        basis = basis[:, s > 1e-6 * s.max()]
        every_column -= basis @ (basis.T @ every_column)
        total += every_column.T @ every_column
    spread = {"tilt": errors.tilt_rad, "scale": errors.scale}
    prior = [spread[key[0]] ** -2.0 for key, (_, columns) in places.items() for _ in columns]
    mixed = total[:size, size:]
    information = total[:size, :size] - mixed @ np.linalg.solve(total[size:, size:] + np.diag(prior), mixed.T)
    return Seen(names, numbers, np.array([p.prior[1] for p in parameters]), information)


def _errors(truth: dict[str, Any]) -> Errors:
    return Errors(**{key: value for key, value in truth["errors"].items() if key != "carried"})


def _starts(places: dict[Any, Any], first: int) -> dict[Any, int]:
    """Return the first column of the values of each episode and session, and that after the last."""
    found: dict[Any, int] = {}
    for key, (_, columns) in places.items():
        found[key] = first
        first += len(columns)
    return {**found, "end": first}


def _whitened(flights: Segments, slopes: Array, k: int, errors: Errors, bursts_s: Sequence[Sequence[float]]) -> Array:
    """Return the derivatives (n, P + S) of a flight's measurements over the root of the true covariance."""
    observed, parts = flights.observations, []
    sizes = ((errors.white_m, errors.slow_m, errors.burst_m), (errors.white_rad, errors.slow_rad, errors.burst_rad))
    for kind, (white, slow, burst) in enumerate(sizes):
        mask = (observed.seen, observed.has_orientation)[kind][k, :, 0].numpy() > 0
        if mask.sum() < LEAST_FRAMES:
            continue
        t = observed.times_s[k].numpy()[mask]
        wrong = np.any([(t >= a) & (t <= b) for a, b in bursts_s] or [np.zeros(len(t), bool)], axis=0)
        covariance = slow**2 * slow_correlation(t, errors.slow_s, errors.slow_kind)
        covariance += np.diag(white**2 + burst**2 * wrong)
        root = np.linalg.cholesky(covariance) / flights.noise[kind]
        own = slopes[k][mask][:, 3 * kind : 3 * kind + 3].reshape(len(t), -1)
        parts.append(np.linalg.solve(root, own).reshape(3 * len(t), -1))
    return np.concatenate(parts)


def limit(found: Seen, effect: dict[str, Any]) -> tuple[float, float] | None:
    """Return the square of a true effect in standard errors, and what the best of another class leaves of it."""
    name, true = effect["name"], np.zeros(len(found.names))
    for k, (own, number) in enumerate(zip(found.names, found.numbers, strict=True)):
        true[k] = effect["values"].get(number, 0.0) if own == name else 0.0
    score = found.information @ true
    square = float(true @ score)
    alike = set[str]().union({name}, *(group for group in EQUIVALENT if name in group))
    others = [_explained(found, score, rival) for rival in set(found.names) - alike]
    return (square, square - max(others, default=0.0)) if true.any() else None


def _explained(found: Seen, score: Array, name: str) -> float:
    """Return what one effect explains of another, from the score of that one."""
    own = [k for k, other in enumerate(found.names) if other == name]
    width = found.width[own]
    values, vectors = np.linalg.eigh(found.information[np.ix_(own, own)] * np.outer(width, width))
    kept = values > MEASURED
    return float(np.square(vectors[:, kept].T @ (score[own] * width) / np.sqrt(values[kept])).sum())


def main(words: Sequence[str] | None = None) -> int:
    """Print what an ideal observer sees of each capture, and how often it is enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--captures", type=Path, default=None, help="as of missing_effects.py")
    parser.add_argument("--only", default="", help="part of the name")
    given = parser.parse_args(words)
    captures = given.captures or ROOT / "out" / "real_like" / given.stage
    rows: list[tuple[float, float, float]] = []
    for path in sorted(captures.with_name(f"{captures.name}.truth").glob("*.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        if truth["row"] not in ("flight", "measurement") or given.only not in truth["name"]:
            continue
        effect, model = truth["effects"][0], captures.with_name(f"{captures.name}.models") / path.stem
        if effect["name"] == "ground_magnet":
            continue
        if not model.is_dir():
            fit(captures / path.stem, model, stage="phys-geo")
        found = limit(seen(model, captures / path.stem, truth), effect)
        if found is not None:
            rows.append((effect["ratio"], *found))
            print(
                f"{truth['name']}: ratio {effect['ratio']:.1f}, chi2 {found[0]:.1f}, apart {found[1]:.1f}", flush=True
            )
    for low, high in BINS:
        inside = [row for row in rows if low <= row[0] < high]
        for least in LIMITS:
            enough = rate([row[1] > least and row[2] > least / 2 for row in inside])
            print(
                f"ratio from {low:g} to {high:g}: above {np.sqrt(least):g} standard errors and apart by half: {enough}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
