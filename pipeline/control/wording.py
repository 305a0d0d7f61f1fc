"""Sentences about runs of a task of control, and the interval of a success rate."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...schemas import AnyTask, ClockName, ControlRun, HandTask

_Z = 1.959964
_ENDS = {
    "timeout": "ran out of time",
    "bad_states": "lost the state",
    "diverged": "diverged",
    "dropped": "dropped the object",
}


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson, "Probable inference", 1927).

    >>> tuple(round(value, 3) for value in wilson(19, 20))
    (0.764, 0.991)
    """
    share, square = count / total, _Z**2 / total
    middle = (share + square / 2) / (1 + square)
    half = _Z * math.sqrt(share * (1 - share) / total + square / total / 4) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def sentence(runs: Sequence[ControlRun], task: AnyTask, clock: ClockName) -> str:
    """Return the outcome of runs in words."""
    good = [run for run in runs if run.ended == "success"]
    place = task.success.position_m
    turn = f"{task.success.turn_deg:.3g} deg"
    bars = turn if place is None else f"{1e3 * place:g} mm and {turn}"
    what = "the goal"
    if isinstance(task, HandTask) and task.success.goals > 1:
        what = f"{task.success.goals} goals in a row"
    words = [f"{len(good)} of {len(runs)} runs reached {what} within {bars}"]
    if good:
        times = sorted(run.time_s for run in good)
        words[0] += f", after {times[len(times) // 2]:.1f} s (median)"
    if isinstance(task, HandTask) and task.success.goals > 1:
        spent_s, goals = sum(run.time_s for run in runs), sum(run.goals for run in runs)
        spent = f"{spent_s:.1f} s" if spent_s < 60 else f"{spent_s / 60:.1f} minutes"
        words.append(f"{goals} goal{'s' * (goals != 1)} in {spent}")
    for kind, text in _ENDS.items():
        count = sum(run.ended == kind for run in runs)
        words += [f"{count} {text}"] if count else []
    plans, late = sum(run.plans for run in runs), sum(run.late_plans for run in runs)
    timed = f"{late} of {plans} plans were late" if clock == "real" else "plans acted at once (ideal clock)"
    return "; ".join([*words, timed]) + "."


def advice(task: AnyTask, taken_s: float) -> str:
    """Return what would make the rate of a task hold where a plan takes `taken_s` [s]; empty where it holds."""
    interval = 1 / task.planner.control_hz
    if taken_s <= interval:
        return "single plans were late; a rate with more room, or an idle machine, avoids it."
    samples = max(4, int(task.planner.samples * interval / taken_s))
    rate = 0.9 / taken_s
    return (
        f"{1 / taken_s:.3g} plans a second are reached: control_hz = {rate:.2g} holds, or about samples = {samples} "
        "(fewer plans are compared), or an idle machine."
    )
