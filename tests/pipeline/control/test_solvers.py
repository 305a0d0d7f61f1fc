"""Solvers of plans on problems whose best solution is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from cgwm.pipeline.control.controller import Controller, ControlState
from cgwm.pipeline.control.hand.elites import Elites
from cgwm.pipeline.control.horizon import Horizon, Targets
from cgwm.pipeline.control.solvers import Mppi, solver_of
from helpers import fused_host
from helpers.pushing import RADIUS, push_task, pushed_model
from helpers.small_model import HALF

NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
SOLVERS = ("mppi", "gauss-newton", "both")
pytestmark = pytest.mark.usefixtures("one_thread")


class Sledge:
    """One degree of freedom: x moves at the commanded speeds; the end x(H) = 0 + H mean(v) is wanted at `goal`.

    Cost: ((x(H) - goal) / s)^2 + mean((v / c)^2). All speeds are equal at the minimum, v = goal H / (H^2 + (s / c)^2).
    """

    shape = (10, 1)
    draws = 1
    goal, horizon, s, c = 0.4, 2.0, 0.1, 0.5

    def __init__(self, bound: float) -> None:
        self.bound = bound

    @property
    def best(self) -> float:
        return min(self.bound, self.goal * self.horizon / (self.horizon**2 + (self.s / self.c) ** 2))

    def residuals(self, values: torch.Tensor, draws: torch.Tensor) -> torch.Tensor:
        end = self.horizon * values.mean((1, 2))
        return torch.cat((((end - self.goal) / self.s)[:, None], values.flatten(1) / self.c / math.sqrt(10)), 1)

    def costs(self, values: torch.Tensor) -> torch.Tensor:
        return self.residuals(values, torch.zeros(len(values))).square().sum(-1)


def nothing(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.zeros((0, 10, 1))


@pytest.mark.parametrize("bound", [1.0, 0.15])
@pytest.mark.parametrize("name", SOLVERS)
def test_one_degree_of_freedom_is_solved_to_its_known_optimum(name, bound: float) -> None:
    problem, rng = Sledge(bound), np.random.default_rng(0)
    lowest = float(problem.costs(torch.full((1, 10, 1), problem.best, dtype=torch.float64)))
    plan = torch.zeros(10, 1, dtype=torch.float64)
    for _ in range(12):  # plans follow each other, each warm-started by the one before
        found = solver_of(name, Mppi(64)).solve(problem, plan, nothing, rng)
        assert found.cost <= float(problem.costs(plan[None])) + 1e-12  # never worse than the plan before
        assert found.values.abs().max() <= bound
        plan = found.values
    tolerance = 1e-6 if name != "mppi" else 0.02
    assert found.cost - lowest <= tolerance * (1 + lowest)
    assert float(plan.mean()) == pytest.approx(problem.best, abs=0.01 if name == "mppi" else 1e-3)


@pytest.mark.parametrize("bound", [1.0, 0.15])
def test_means_of_the_best_samples_stay_about_the_known_optimum(bound: float) -> None:
    problem, rng = Sledge(bound), np.random.default_rng(0)
    plan, means = torch.zeros(10, 1, dtype=torch.float64), []
    for _ in range(150):
        found = Elites(16).solve(problem, plan, nothing, rng)
        assert found.cost <= float(problem.costs(plan[None])) + 1e-12  # the plan before is a sample
        assert found.values.abs().max() <= bound
        plan = found.values
        means.append(float(plan.mean()))
    assert np.mean(means[50:]) == pytest.approx(problem.best, rel=0.1)


def test_changes_of_elites_are_cubics_whose_beginning_is_small() -> None:
    """Three differences of a cubic are equal; with the plan before at 0 and one sample kept, the result is a sample."""
    kept = [
        Elites(12, best=1).solve(Sledge(100.0), torch.full((10, 1), 5.0, dtype=torch.float64), nothing,
                                 np.random.default_rng(seed)).values[:, 0] for seed in range(20)
    ]  # fmt: skip
    values = torch.stack(kept).numpy()
    np.testing.assert_allclose(np.diff(values, 4), 0.0, atol=1e-9)
    assert np.abs(values[:, 0] - 5.0).mean() < 0.7 * np.abs(values[:, -1] - 5.0).mean()


def test_a_plan_that_is_shifted_says_the_same() -> None:
    """Pieces end at multiples of a constant, so that the targets of a plan are kept exactly while time passes."""
    first = Horizon.of(0.0, 0.0, 1.0, 5)
    plan = Targets(times_s=first.times_s, values_m=np.random.default_rng(0).normal(size=(6, 2)))
    later = Horizon.of(0.33, 0.43, 1.0, 5)
    assert later.times_s[0] == 0.33 and later.times_s[later.given] == 0.43
    assert len(later.lengths_s) == 5 and later.lengths_s.min() >= 0.25 * 0.2 - 1e-12
    speeds = plan.speeds(later.times_s)
    moved = plan.at(0.33) + np.cumsum(speeds * np.diff(later.times_s)[:, None], 0)
    np.testing.assert_allclose(moved, plan.at(later.times_s[1:]), atol=1e-12)
    np.testing.assert_allclose(speeds[later.times_s[1:] > 1.2], 0.0)


@NEEDS_COMPILER
@pytest.mark.parametrize("name", ["gauss-newton", "both"])
def test_a_straight_push_ends_where_the_object_is_wanted(name) -> None:
    """The best push to a goal straight ahead is known: behind the object, by the distance to the goal and the gap."""
    task = push_task(goal={"position_m": [0.02, 0.0]}, limits={"speed_m_s": 0.2})
    controller = Controller(pushed_model(), task, name)
    for time_s in (0.0, 0.001, 0.002):
        assert controller.plan(resting(time_s, (-HALF - RADIUS + 0.0005, 0.0))) is not None
    predicted = controller.forecast()
    assert predicted.position_m[-1, 0] == pytest.approx(0.02, abs=0.002)
    assert abs(predicted.position_m[-1, 1]) < 0.002


def resting(time_s: float, finger: tuple[float, float]) -> ControlState:
    joints = dict(zip(("x", "y"), finger, strict=True))
    return ControlState(
        time_s=time_s, joints=joints, position_m=np.array([0, 0, HALF]), quat_wxyz=np.array([1.0, 0, 0, 0])
    )
