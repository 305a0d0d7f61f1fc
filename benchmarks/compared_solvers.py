"""What each solver makes of the same plan: a solver that asks others at some of the plans of a run (see `hand.py`).

The run goes on with the plans of the first one. Each solver begins at the plan before, with the same random numbers;
its cost is that of the sequence that it returns, under the predictions of the controller.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from cgwm.pipeline.control.hand.elites import Elites
from cgwm.pipeline.control.objective import Draw, Objective
from cgwm.pipeline.control.solvers import Both, GaussNewton, Solution, Solver

Note = Callable[[int, dict[str, Any]], object]
EVERY, MOST = 15, 8
"""Plans from one comparison to the next, and comparisons in a run."""


def solvers_of(samples: int) -> dict[str, Solver]:
    """Return the solvers by name; the first is the one of hands."""
    return {
        "mppi": Elites(samples),
        "mppi, four times the samples": Elites(4 * samples),
        "both": Both(Elites(samples)),
        "gauss-newton": GaussNewton(),
    }


class ComparedSolvers:
    """A solver that notes what others make of every some plans.

    Args:
        solvers: The solvers by name.
        note: Takes the number of a plan and the figures of all solvers.
    """

    def __init__(self, solvers: Mapping[str, Solver], note: Note) -> None:
        self._solvers, self._note = solvers, note
        self._plans = 0

    def solve(self, objective: Objective, warm: torch.Tensor, propose: Draw, rng: np.random.Generator) -> Solution:
        """See `cgwm.pipeline.control.solvers.Solver`."""
        number = self._plans
        self._plans += 1
        first = next(iter(self._solvers.values()))
        if number == 0 or number % EVERY or number > EVERY * MOST:
            return first.solve(objective, warm, propose, rng)
        figures = {"plan before": {"cost": float(objective.costs(warm[None])[0])}}
        for name, solver in self._solvers.items():
            began, own = time.process_time(), copy.deepcopy(rng)
            values = solver.solve(objective, warm, propose, own).values
            cpu_ms = 1e3 * (time.process_time() - began)
            figures[name] = {"cost": float(objective.costs(values[None])[0]), "cpu_ms": round(cpu_ms, 1)}
        self._note(number, figures)
        return first.solve(objective, warm, propose, rng)
