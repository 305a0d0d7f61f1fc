"""A clock of plans that other processes do not lengthen."""

from __future__ import annotations

from dataclasses import replace

from cgwm.pipeline.control.planning import ControlPlan, ControlState, PlanningController


def charge_processors(controller: PlanningController) -> None:
    """Let plans take the time of all processors in place of the wall time, which other processes lengthen."""
    made = type(controller).plan

    def plan(state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        found = made(controller, state, acts_s)
        return None if found is None else replace(found, wall_s=found.cpu_s)

    controller.plan = plan
