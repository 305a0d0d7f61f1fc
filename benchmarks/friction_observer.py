"""Which friction an observer finds in one motion who knows the engine's own law, the body and the errors' sizes.

    pip install --no-deps -r benchmarks/requirements.txt
    python benchmarks/friction_observer.py run --engines mujoco,dart,rapier,drake --workers 2
    python benchmarks/friction_observer.py table

The motions to learn from of Fall, Push and Tip, as `fall_push.py` draws them (development seeds), at their 15 frames.
The engine that made a motion repeats it with other frictions, from the true start; the observer chooses the friction
that fits best what it sees: the true poses with errors as poses found in videos have them, `WHITE` ones of each frame
and `SLOW` ones that change within `SLOW_S`, whose size it knows. What it does not know, but for the friction, is

- nothing (`all known`);
- the `start`: twelve numbers of a body that flies, place and heading of one that lies, uncertain as far as the poses;
- the start and the `numbers`: natural time and damping ratio of the contact, and the friction of the fingertip, to
  `NUMBERS` of their logarithm, as the prior of a fit has them.

The unknowns act by their derivatives at the truth. No fit that does not know more can be nearer to the friction that
the engine was given, but by chance; a fit whose law is not the engine's is farther away. An error is the median of
`DRAWS` draws of the errors of the poses and of the unknowns.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.synthetic.dynamics import ContactTruth
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.schemas import NotConvergedError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from store import Store
from tabletop.capture import TASKS, plan_capture
from tabletop.engines import ENGINES, refusal
from tabletop.jobs import CaptureJob
from tabletop.materials import MATERIALS
from tabletop.objects import load_item

Array = NDArray[np.float64]

FACTORS = np.exp(1e-3 * np.sinh(np.linspace(-7.5, 7.5, 91)))
"""Frictions that are tried, in units of the true one: near it by 0.02 %, at most by a factor of 2.5."""
WHITE, SLOW, SLOW_S = (1.5e-4, 4e-3), (4e-4, 1e-2), 0.15
"""Standard deviations of the errors of poses [m, rad], and the time over which the slow ones are alike [s]."""
START = (1e-2, 1e-1, 1.0, 5.0)
"""How uncertain a start is, but for what the poses tell: place [m], turn [rad] and their rates [m/s, rad/s]."""
NUMBERS = 0.5
STEPS = (1e-4, 2e-3, 1e-2, 5e-2, 5e-2)
"""Of the derivatives: place, turn, velocity, spin, and logarithms of numbers."""
DRAWS = 400
KNOWN = ("all known", "start", "start and numbers")
OBJECTS, SEEDS = ("box", "l_block"), (110, 111)


def measure(job: CaptureJob) -> dict[str, Any]:
    """Return the median error of friction by what is not known, or why there is none."""
    item = load_item(job.object)
    reason = refusal(job.engine, item.solid)
    if reason is not None:
        return vars(job) | {"not_run": reason}
    try:
        plan, _ = plan_capture(item, job.object, job.material, job.task, job.seed, 0, job.engine)
    except NotConvergedError as error:
        return vars(job) | {"not_run": error.found}
    times = np.arange(plan.episodes[0].frame_count) / plan.frame_rate
    seen = repeater(plan, job.engine, times)
    truth = seen(plan.contact, np.zeros(12))
    frictions = [float(factor) * plan.contact.friction for factor in FACTORS]
    still = np.zeros(12)
    tried = np.stack([apart(seen(replace(plan.contact, friction=one), still), truth) for one in frictions])
    start, numbers = _start(seen, plan, truth), _numbers(seen, plan, truth)
    unknown: dict[str, tuple[Array, Array]] = {
        "all known": (np.zeros((tried.shape[1], 0)), np.zeros(0)),
        "start": start,
        "start and numbers": (np.hstack((start[0], numbers[0])), np.concatenate((start[1], numbers[1]))),
    }
    errors = covariance(times)
    found = {name: medians(tried, errors, by, uncertain, job.seed) for name, (by, uncertain) in unknown.items()}
    return vars(job) | {"errors": found, "true": plan.contact.friction}


def repeater(plan: ScenePlan, engine: str, times_s: Array) -> Callable[[ContactTruth, Array], tuple[Array, Rotation]]:
    """Return what the engine makes of the motion to learn from: poses at times, of a contact and a changed start.

    Args:
        plan: Of a capture.
        engine: Its engine.
        times_s: Where poses are wanted [s], shape (T,).
    """
    motion = plan.episodes[0].motion
    first = 0 if plan.fingertip else motion.row(0.0)  # a body that is pushed settles before
    command = (motion.qpos[first:, 7:10], motion.qvel[first:, 6:9]) if plan.fingertip else None
    begin = motion.start if plan.fingertip else 0.0

    def seen(contact: ContactTruth, change: Array) -> tuple[Array, Rotation]:
        qpos, qvel = motion.qpos[first, :7].copy(), motion.qvel[first, :6] + change[6:]
        qpos[:3] += change[:3]
        turned = Rotation.from_rotvec(change[3:6]) * Rotation.from_quat(qpos[3:7], scalar_first=True)
        qpos[3:7] = turned.as_quat(scalar_first=True)
        made = ENGINES[engine].make(plan.solid, contact, plan.fingertip)
        got = made.simulate(qpos, qvel, begin, float(times_s[-1]) + 1e-3, command)
        pose = got.qpos[got.rows(times_s)]
        return pose[:, :3], Rotation.from_quat(pose[:, 3:7], scalar_first=True)

    return seen


def apart(one: tuple[Array, Rotation], other: tuple[Array, Rotation]) -> Array:
    """Return by how far poses are apart, frame by frame: place [m] and rotation vector [rad], shape (6 T,)."""
    return np.hstack((one[0] - other[0], (one[1] * other[1].inv()).as_rotvec())).reshape(-1)


def covariance(times_s: Array) -> Array:
    """Return the covariance of the errors of poses, shape (6 T, 6 T)."""
    alike = np.exp(-0.5 * ((times_s[:, None] - times_s) / SLOW_S) ** 2)
    parts = [w**2 * np.eye(len(times_s)) + s**2 * alike for w, s in zip(WHITE, SLOW, strict=True) for _ in range(3)]
    full = np.zeros((len(times_s), 6, len(times_s), 6))
    for axis, part in enumerate(parts):
        full[:, axis, :, axis] = part
    return full.reshape(6 * len(times_s), -1)


def _start(seen: Any, plan: ScenePlan, truth: tuple[Array, Rotation]) -> tuple[Array, Array]:
    """Return derivatives by the start (6 T, n) and how uncertain it is (n,)."""
    chosen = (0, 1, 5) if plan.fingertip else range(12)
    columns = []
    for k in chosen:
        change = np.zeros(12)
        change[k] = STEPS[k // 3]
        ends = [apart(seen(plan.contact, sign * change), truth) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * STEPS[k // 3]))
    return np.stack(columns, -1), np.array([START[k // 3] for k in chosen])


def _numbers(seen: Any, plan: ScenePlan, truth: tuple[Array, Rotation]) -> tuple[Array, Array]:
    """Return derivatives by the logarithms of the contact's other numbers (6 T, n), and how uncertain they are (n,)."""
    names = ["natural_time", "damping_ratio"] + (["friction_fingertip"] if plan.fingertip else [])
    columns = []
    for name in names:
        value = getattr(plan.contact, name)
        changed = [replace(plan.contact, **{name: value * math.exp(sign * STEPS[4])}) for sign in (1, -1)]
        ends = [apart(seen(contact, np.zeros(12)), truth) for contact in changed]
        columns.append((ends[0] - ends[1]) / (2 * STEPS[4]))
    return np.stack(columns, -1), np.full(len(names), NUMBERS)


def medians(tried: Array, errors: Array, by: Array, uncertain: Array, seed: int) -> float:
    """Return the median error of the logarithm of the factor that fits best.

    Args:
        tried: What the poses of each factor differ by from the true ones, shape (factor, n).
        errors: Covariance of what is seen of the true ones, shape (n, n).
        by: Derivatives by what is not known, shape (n, k).
        uncertain: How uncertain it is, shape (k,).
        seed: Of the draws.
    """
    both = errors + (by * uncertain**2) @ by.T
    draw = np.random.default_rng(seed).standard_normal
    noise = draw((DRAWS, len(errors))) @ np.linalg.cholesky(errors).T + draw((DRAWS, len(uncertain))) * uncertain @ by.T
    weighed = np.linalg.solve(both, tried.T)  # (n, factor)
    misfit = (weighed * tried.T).sum(0)[None] - 2 * noise @ weighed
    return float(np.median(np.abs(np.log(FACTORS[misfit.argmin(1)]))))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the median errors of friction [%] by task and engine in Markdown, after the largest one."""
    lines = ["| task | engine | motions | " + " | ".join(KNOWN) + " |", "| --- " * (len(KNOWN) + 3) + "|"]
    engines = [name for name in ENGINES if any(row["engine"] == name for row in rows)]
    for task, engine in itertools.product(TASKS, (*engines, "all")):
        here = [row for row in rows if row["task"] == task and engine in (row["engine"], "all")]
        found = [row["errors"] for row in here if "errors" in row]
        if found:
            cells = [
                f"{100 * np.median([one[name] for one in found]):.1f} (to {100 * max(one[name] for one in found):.1f})"
                for name in KNOWN
            ]
            lines.append(f"| {task} | {engine} | {len(found)} | " + " | ".join(cells) + " |")
    lost = sorted({f"{r['engine']}, {r['task']}, {r['object']}: {r['not_run']}" for r in rows if "not_run" in r})
    return "\n".join((*lines, *(f"Not run: {reason}" for reason in lost)))


def main() -> int:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--engines", default="mujoco,dart,rapier,drake", help=", ".join(ENGINES))
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--seeds", default=",".join(map(str, SEEDS)), help="of the captures, below 500")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    store = Store("friction_observer", given.store, given.any_commit)
    if given.what == "run":
        tasks, engines, objects = (getattr(given, name).split(",") for name in ("tasks", "engines", "objects"))
        seeds = [int(seed) for seed in given.seeds.split(",")]
        jobs = [CaptureJob(*one) for one in itertools.product(tasks, objects, MATERIALS, engines, seeds)]
        order = np.random.default_rng(0).permutation(len(jobs))
        store.fill(measure, {jobs[k].key: (jobs[k],) for k in order}, given.workers)
    print(table(store.results()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
