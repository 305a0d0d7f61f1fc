"""Which effects of contact an observer could name who knows the true law, the body and the errors: a limit of any rule.

    python benchmarks/contact_observer.py --stage development --count 60 --workers 2 --out out/observer.jsonl

The cases are those of the row "contact" of `missing_effects.py`. Each training episode is cut into pieces of at most
`PIECE_S`; from the true state at its beginning each piece is simulated in the engine that made it, with and without
the effect, with changed states, friction and damping of the contact, and with each of its rivals, the other effects of
contact that the engine can hide. What is not known are the state at the beginning of each piece, one friction, one
damping, and the size of one effect. Under the true covariance of the errors (white, slow and bursts; smoothing can be
undone), with the unknowns projected out,

- `chi2` is the square of the true effect in standard errors, what a test of this effect expects beside chance,
- `apart` what the best rival leaves of it, and `rival` its name.

A rival that depends on a place counts once for each of `PLACES` places, one with a direction for each of its signs.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.hidden_effects import EFFECTS
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Start, build
from cgwm.datasets.synthetic.hidden_effects.protocol import draw_start, motions
from cgwm.datasets.synthetic.hidden_effects.record import poses
from cgwm.datasets.synthetic.hidden_effects.registry import draw_effect
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of
from cgwm.datasets.synthetic.hidden_effects.things import Array
from real_like import STAGES, real_cases
from real_like.engines import GROUPS, can_hide, missing
from real_like.errors import Errors, draw_errors, noise, slow_correlation
from real_like.plan import RealCase
from real_like.score import rate
from real_like.sizes import Bench, sized_effect
from scipy.spatial.transform import Rotation

PIECE_S = 0.3
"""Longest piece: the derivatives of a tumbling body grow with its length beyond any use."""
LEAST_FRAMES = 6
PLACES = 3
STEPS = np.repeat([2e-5, 2e-4, 2e-3, 2e-2], 3)
"""Changes of place [m], turn [rad], velocity [m/s] and spin [rad/s]."""
FRICTION_STEP, DAMPING_STEP = 0.01, 0.02
"""Changes of friction and, relatively, of the damping."""
NAMED = (25.0, 12.5)
"""Least `chi2` and `apart`: five standard errors, and odds of 500 against the best rival."""
BINS = ((3.0, 10.0), (10.0, 30.0), (30.0, np.inf))


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of an episode: its first state, its frames from there [s], and the root of their true covariance."""

    start: Start
    times_s: Array
    roots: tuple[Array, Array]


def seen_by_observer(case: RealCase) -> dict[str, Any]:
    """Return what an ideal observer sees of a case with one effect of contact."""
    engine, body = GROUPS[case.group][0], case.body_case()
    thing, errors = body.drawn_thing(), draw_errors(case.rng("errors"), body.rate_hz)
    world, kinds = Mechanics.of(thing, body.law), motions(body.protocol, body.train, body.test)[: body.train]
    starts = [draw_start(thing, kind, case.rng(f"start {k}")) for k, kind in enumerate(kinds)]
    bench = Bench(
        thing=thing,
        world=world,
        simulate=engine.simulate,
        episodes=list(zip(kinds, starts, strict=True)),
        length_s=body.length_s,
        errors=errors,
        turned=not body.centroid_only,
    )
    sized = sized_effect(case.effects[0], bench, [case.seed, *case.effects[0].encode()])
    rivals = _rivals(case)
    columns, rows = 2 + len(rivals), [np.zeros((0, 3 + len(rivals)))]
    for k, start in enumerate(starts):
        motion = engine.simulate(build(world, [sized.effect]), [sized.effect], start, body.length_s)
        for piece in _pieces(motion, body.rate_hz, body.length_s, errors, case.rng(f"{k:03d}")):
            rows.append(_projected(piece, engine, world, sized.effect, [effect for _, effect in rivals], body.rate_hz))
    every = np.concatenate(rows)
    true, known, others = every[:, columns], every[:, :2], every[:, 2:columns]
    chi2 = _left(true, known)
    found = {}
    for k, (name, _) in enumerate(rivals):
        left = _left(true, np.column_stack([known, others[:, k]]))
        found[name] = min(left, found.get(name, np.inf))
    best = min(found, key=lambda name: found[name], default="")
    return {
        "case": case.name,
        "group": case.group,
        "effect": case.effects[0],
        "ratio": sized.ratio,
        "chi2": chi2,
        "apart": found.get(best, chi2),
        "rival": best,
        "named": bool(chi2 > NAMED[0] and found.get(best, chi2) > NAMED[1]),
    }


def _rivals(case: RealCase) -> list[tuple[str, Hidden]]:
    """Return the other effects of contact, small ones, with several places of those that have one."""
    thing, found = case.body_case().drawn_thing(), []
    for name, entry in EFFECTS.items():
        if entry.acts != "contact" or name in case.effects or not can_hide(case.group, name):
            continue
        if thing.kind in entry.things:
            for place in range(PLACES if name == "friction_patch" else 1):
                found.append((name, draw_effect(name, thing, "small", np.random.default_rng(place))))
    return found


def _pieces(motion: Motion, rate_hz: float, length_s: float, errors: Errors, rng: np.random.Generator) -> list[Piece]:
    """Return the pieces of an episode that touch the ground, of equal lengths, with states from the motion's steps."""
    times = np.arange(int(length_s * rate_hz)) / rate_hz
    bursts = noise(errors, times, rng)[2]
    size = max(int(PIECE_S * rate_hz), LEAST_FRAMES)
    found = []
    for part in np.array_split(times, max(round(len(times) / size), 1)):
        inside = (motion.time_s >= part[0]) & (motion.time_s <= part[-1])
        if not motion.touching[inside].any():
            continue
        found.append(Piece(_state(motion, float(part[0])), part - part[0], _roots(errors, part, bursts)))
    return found


def _state(motion: Motion, time_s: float) -> Start:
    """Return the state at a time, its speeds from the steps about it."""
    k = int(np.clip(round(time_s / (motion.time_s[1] - motion.time_s[0])), 0, len(motion.time_s) - 2))
    step_s = float(motion.time_s[k + 1] - motion.time_s[k])
    here, there = (rotation_of(motion.quat_wxyz[j]) for j in (k, k + 1))
    spin = Rotation.from_matrix(here.T @ there).as_rotvec() / step_s
    velocity = (motion.position_m[k + 1] - motion.position_m[k]) / step_s
    return Start(motion.position_m[k], motion.quat_wxyz[k], velocity, spin)


def _roots(errors: Errors, times_s: Array, bursts_s: Sequence[Sequence[float]]) -> tuple[Array, Array]:
    wrong = np.any([(times_s >= a) & (times_s <= b) for a, b in bursts_s] or [np.zeros(len(times_s), bool)], axis=0)
    sizes = ((errors.white_m, errors.slow_m, errors.burst_m), (errors.white_rad, errors.slow_rad, errors.burst_rad))
    roots = []
    for white, slow, burst in sizes:
        covariance = slow**2 * slow_correlation(times_s, errors.slow_s, errors.slow_kind)
        roots.append(np.linalg.cholesky(covariance + np.diag(white**2 + burst**2 * wrong)))
    return roots[0], roots[1]


def _projected(
    piece: Piece, engine: Any, world: Mechanics, effect: Hidden, rivals: Sequence[Hidden], rate_hz: float
) -> Array:
    """Return whitened columns of a piece without what its state can follow: friction, damping, rivals, the effect."""
    length_s = float(piece.times_s[-1]) + 1 / rate_hz

    def moved(world: Mechanics, hidden: Sequence[Hidden], start: Start) -> tuple[Array, Array]:
        return poses(engine.simulate(build(world, hidden), hidden, start, length_s), piece.times_s)

    base = moved(world, [], piece.start)

    def column(world: Mechanics, hidden: Sequence[Hidden], start: Start) -> Array:
        position, rotation = moved(world, hidden, start)
        turned = Rotation.from_matrix(np.einsum("tji,tjk->tik", base[1], rotation)).as_rotvec()
        parts = zip(piece.roots, (position - base[0], turned), strict=True)
        return np.concatenate([np.linalg.solve(root, part).ravel() for root, part in parts], dtype=float)

    thing, mu = world.thing, world.friction[0]
    rougher = replace(
        world,
        thing=replace(thing, friction=thing.friction + FRICTION_STEP),
        friction=(mu + FRICTION_STEP, mu + FRICTION_STEP),
    )
    damped = replace(world, thing=replace(thing, damping_ratio=thing.damping_ratio * (1 + DAMPING_STEP)))
    states = np.column_stack([column(world, [], _changed(piece.start, k)) / STEPS[k] for k in range(12)])
    own = [column(rougher, [], piece.start), column(damped, [], piece.start)]
    own += [column(world, [rival], piece.start) for rival in rivals]
    rows = np.column_stack([*own, column(world, [effect], piece.start)])
    basis, s, _ = np.linalg.svd(states / np.linalg.norm(states, axis=0).clip(1e-12), full_matrices=False)
    basis = basis[:, s > 1e-6 * s.max()]
    return np.asarray(rows - basis @ (basis.T @ rows))


def _changed(start: Start, k: int) -> Start:
    """Return a start with one of its twelve coordinates changed."""
    step = np.zeros(12)
    step[k] = STEPS[k]
    quat = Rotation.from_quat(start.quat_wxyz, scalar_first=True) * Rotation.from_rotvec(step[3:6])
    return Start(
        start.position_m + step[:3],
        quat.as_quat(scalar_first=True),
        start.velocity_m_s + step[6:9],
        start.omega_body_rad_s + step[9:],
    )


def _left(value: Array, columns: Array) -> float:
    """Return the square of what least squares over columns leaves of a value."""
    scaled = columns / np.linalg.norm(columns, axis=0).clip(1e-12)
    basis, s, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = basis[:, s > 1e-6]
    return float(np.square(value - basis @ (basis.T @ value)).sum())


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return how many effects could be named, by ratio and by name."""
    lines = []
    for low, high in BINS:
        inside = [row["named"] for row in rows if low <= row["ratio"] < high]
        lines.append(f"ratio from {low:g} to {high:g}: could be named {rate(inside)}")
    lines.append(f"all: could be named {rate([row['named'] for row in rows])}")
    for name in sorted({row["effect"] for row in rows}):
        own = [row for row in rows if row["effect"] == name]
        rivals = sorted({row["rival"] for row in own if not row["named"]})
        lines.append(f"  {name}: {sum(row['named'] for row in own)} of {len(own)}" + f" ({', '.join(rivals)})")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Print what an ideal observer sees of each case, and how often it is enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", choices=STAGES, default="development")
    parser.add_argument("--count", type=int, default=60, help="captures of the row, of all groups")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after this time")
    parser.add_argument("--out", type=Path, required=True, help="file of the results, JSON lines; known cases are kept")
    given = parser.parse_args(words)
    chosen = [one for one in real_cases(given.stage, 0, given.count) if one.row == "contact"]
    chosen = [one for one in chosen if missing(one.group) is None]
    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.is_file() else []
    known, deadline = {row["case"] for row in rows}, time.monotonic() + given.seconds
    todo = [one for one in chosen if one.name not in known]
    with ProcessPoolExecutor(given.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_within, one, deadline) for one in todo]
        for future in as_completed(futures):
            row = future.result()
            if row is not None:
                rows.append(row)
                with given.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    print(table(rows))
    return 0


def _within(case: RealCase, deadline: float) -> dict[str, Any] | None:
    return seen_by_observer(case) if time.monotonic() < deadline else None


if __name__ == "__main__":
    sys.exit(main())
