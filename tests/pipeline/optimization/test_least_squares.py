"""The least-squares solver: closed forms, bounds, priors, the Schur complement, batches, and reasons for stopping."""

import numpy as np
import pytest
import torch
from cgwm.pipeline.optimization.least_squares import Descent, Policy, Stop, descend
from cgwm.pipeline.optimization.levenberg_marquardt import minimise
from cgwm.pipeline.optimization.problem import FLOOR, Box, NormalEquations, Point, Problem, Rows, damped
from torch import Tensor
from torch.autograd.functional import jacobian
from torch.func import vmap

F64 = torch.float64
TIGHT = Policy(iterations=200, relative=1e-14, absolute=1e-24)


class Curves(Problem):
    """Residuals f(x) - y of groups that share a function and differ in what they measured."""

    def __init__(self, function, measured: Tensor, box: Box) -> None:
        self.function, self.measured, self.box = function, measured, box
        self.owner = torch.arange(len(measured))

    def rows(self, point: Point, rows: Rows) -> Tensor:
        return vmap(self.function)(point.values) - self.measured[rows.items]

    def costs(self, point: Point, rows: Rows) -> Tensor:
        return self.rows(point, rows).square().sum(1)

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        found = self.rows(point, rows)
        slopes = torch.stack([jacobian(self.function, one) for one in point.values])
        return NormalEquations.of_rows(found, slopes, slopes.shape[-1], found.square().sum(1))


def tensor(values: object) -> Tensor:
    return torch.as_tensor(values, dtype=F64)


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def valley(high: float = 9.0, **box: object) -> Curves:
    """Rosenbrock's valley with x of at most `high`."""
    low, centre = tensor([[-9.0, -9.0]]), torch.zeros(1, 2, dtype=F64)
    given = {"low": low, "high": tensor([[high, 9.0]]), "centre": centre, "information": centre}
    return Curves(rosenbrock, torch.zeros(1, 2, dtype=F64), Box(**(given | box)))


def run(problem: Problem, start: object, policy: Policy = TIGHT) -> Descent:
    return descend(problem, Point(values=tensor(start)), policy)


def decay(x: Tensor) -> Tensor:
    return x[0] * torch.exp(-x[1] * torch.linspace(0, 3, 12, dtype=F64)) + x[2]


def decays(truth: object) -> Curves:
    measured = vmap(decay)(tensor(truth))
    return Curves(decay, measured, Box.unbounded(torch.zeros(len(measured), 3, dtype=F64)))


def test_a_valley_is_followed_to_its_minimum() -> None:
    end = run(valley(), [[-1.2, 1.0]])
    assert end.point.values[0].tolist() == pytest.approx([1.0, 1.0], abs=1e-9)
    assert end.converged and end.costs == sorted(end.costs, reverse=True)
    assert end.costs[0] == pytest.approx(24.2)
    assert int(end.evaluations[0]) == len(end.history)  # the start, and one trial in each iteration
    assert int(end.linearisations[0]) == 1 + int(end.accepted[0])


def test_a_bound_holds_one_parameter_and_the_other_reaches_the_minimum_on_it() -> None:
    end = run(valley(high=0.5), [[-1.2, 1.0]])
    assert end.point.values[0].tolist() == pytest.approx([0.5, 0.25], abs=1e-9)
    assert float(end.cost) == pytest.approx(0.25)


def test_a_parameter_with_equal_bounds_is_not_fitted() -> None:
    end = run(valley(high=0.3, low=tensor([[0.3, -9.0]])), [[0.3, 1.0]])
    assert end.point.values[0].tolist() == pytest.approx([0.3, 0.09])


def test_a_prior_and_a_measurement_meet_at_their_weighted_mean() -> None:
    box = Box.within(tensor([[-9.0, 9.0]]), tensor([1.0]), tensor([3.0]))
    end = run(Curves(lambda x: x + x, tensor([[8.0]]), box), [[0.0]])
    assert float(end.point.values) == pytest.approx((4 * 4 + 3 * 1) / (4 + 3))
    assert float(end.information()) == pytest.approx(4 + 3)
    assert float(end.cost) == pytest.approx(4 * 3 / (4 + 3) * (4 - 1) ** 2)


def test_directions_without_information_stay_where_they_are() -> None:
    ones = torch.arange(1, 11, dtype=F64)
    problem = Curves(
        lambda x: ones * (x[0] + x[1]), torch.ones(1, 10, dtype=F64), Box.unbounded(torch.zeros(1, 3, dtype=F64))
    )
    end = run(problem, [[2.0, 1.0, 5.0]])
    assert float(end.cost) == pytest.approx(10 * 9 / 42)
    assert end.point.values[0, :2].diff().item() == pytest.approx(-1.0)
    assert float(end.point.values[0, 2]) == 5.0


def test_units_of_the_parameters_change_no_cost() -> None:
    """Damping relative to the diagonal: the path is the same in metres and micrometres."""
    unit = tensor([1e6, 1e-3])
    scaled = Curves(lambda x: rosenbrock(x * unit), torch.zeros(1, 2, dtype=F64), Box.unbounded(unit[None]))
    plain, other = run(valley(), [[-1.2, 1.0]]), run(scaled, (tensor([[-1.2, 1.0]]) / unit).tolist())
    assert plain.costs[:10] == pytest.approx(other.costs[:10], rel=1e-6)


def test_groups_of_a_batch_descend_as_they_do_alone() -> None:
    truth, start = [[2.0, 0.5, 0.1], [1.0, 3.0, -0.2], [5.0, 1.0, 2.0]], [[1.0, 1.0, 0.0]] * 3
    policy = Policy(iterations=40, relative=1e-9, absolute=1e-18, factors=(0.1, 1.0, 10.0), shares=(1.0, 0.5))
    together = run(decays(truth), start, policy)
    for k, one in enumerate(truth):
        alone = run(decays([one]), start[:1], policy)
        assert together.point.values[k].tolist() == pytest.approx(alone.point.values[0].tolist(), rel=1e-9)
        assert together.reasons[k] == alone.reasons[0]
        for name in ("evaluations", "linearisations", "accepted"):
            assert int(getattr(together, name)[k]) == int(getattr(alone, name)[0])
    assert together.point.values.tolist() == pytest.approx(tensor(truth).numpy(), abs=1e-6)


def arrow(generator: np.random.Generator, items: int, states: int, count: int) -> NormalEquations:
    """Normal equations of random residuals."""
    rows, jacobian = generator.normal(size=(items, 9)), generator.normal(size=(items, 9, count + states))
    return NormalEquations.of_rows(tensor(rows), tensor(jacobian), count, tensor(rows**2).sum(1), prior=0.1)


def test_the_schur_complement_is_the_dense_solution() -> None:
    items, states, count = 4, 3, 2
    normal = arrow(np.random.default_rng(0), items, states, count)
    size = count + items * states
    matrix, right = torch.zeros(size, size, dtype=F64), torch.zeros(size, dtype=F64)
    matrix[:count, :count], right[:count] = normal.information.sum(0), normal.slope.sum(0)
    for k in range(items):
        own = slice(count + k * states, count + (k + 1) * states)
        matrix[own, own], right[own] = normal.states[k], normal.state_slope[k]
        matrix[own, :count], matrix[:count, own] = normal.mixed[k], normal.mixed[k].T
    whole = torch.linalg.solve(matrix, right)
    reduced = normal.eliminated()
    step = torch.linalg.solve(reduced.information.sum(0), reduced.score.sum(0))
    assert step.tolist() == pytest.approx(whole[:count].tolist())
    assert reduced.following(step.expand(items, -1)).flatten().tolist() == pytest.approx(whole[count:].tolist())
    inverse = torch.linalg.inv(matrix)[:count, :count]
    assert torch.allclose(torch.linalg.inv(reduced.information.sum(0)), inverse)


def test_a_weight_of_an_item_changes_no_step_of_its_state() -> None:
    normal = arrow(np.random.default_rng(1), 3, 2, 2)
    weight = tensor([0.5, 1.0, 2.0])
    plain, heavy = normal.eliminated(), normal.weighted(weight).eliminated()
    assert torch.allclose(plain.state_step, heavy.state_step)
    assert torch.allclose(weight[:, None] * plain.score, heavy.score)


def test_damping_multiplies_the_diagonal_or_units() -> None:
    """Marquardt's and Levenberg's: damping 2 of a diagonal of 9 and 0, and of units 1 and 4."""
    normal = NormalEquations(
        states=tensor([[[9.0, 0.0], [0.0, 0.0]]]),
        mixed=torch.zeros(1, 2, 0, dtype=F64),
        information=torch.zeros(1, 0, 0, dtype=F64),
        state_slope=tensor([[27.0, 16.0]]),
        slope=torch.zeros(1, 0, dtype=F64),
        cost=tensor([1.0]),
    )
    assert normal.eliminated(tensor([2.0])).state_step[0].tolist() == pytest.approx([1.0, 16.0 / (2 * FLOOR)])
    assert normal.eliminated(tensor([2.0]), tensor([1.0, 4.0])).state_step[0].tolist() == pytest.approx([27 / 11, 2.0])


def test_outliers_have_no_influence_with_cauchys_loss() -> None:
    wrong = tensor([0.01, -0.02, 0.03, 0.0, -0.01, 60.0, -0.02, 90.0])

    def residuals(shared: Tensor, states: Tensor, with_jacobian: bool):
        rows = (shared - wrong)[None, :, None] / 0.02
        return rows, torch.full((1, 8, 1, 1), 50.0, dtype=F64) if with_jacobian else None

    nothing, bounds = torch.zeros(1, 0, dtype=F64), tensor([[-99.0, 99.0]])
    robust = minimise(residuals, tensor([0.1]), nothing, bounds, robust_scale=2.0, iterations=100, tolerance=1e-12)
    assert abs(float(robust.shared)) < 0.01
    plain = minimise(residuals, tensor([0.1]), nothing, bounds, tolerance=1e-12)
    assert float(plain.shared) == pytest.approx(float(wrong.mean()))


@pytest.mark.parametrize(
    ("start", "policy", "reason"),
    [
        ([[-1.2, 1.0]], TIGHT, Stop.CONVERGED),
        ([[-1.2, 1.0]], Policy(iterations=3), Stop.ITERATIONS),
        ([[-1.2, 1.0]], Policy(iterations=99, steps=2), Stop.ITERATIONS),
        ([[1.0, 1.0]], Policy(iterations=99), Stop.NO_LOWER_COST),
        ([[-1.2, 1.0]], Policy(iterations=99, damping=0.0, least_damping=0.0, attempts=1), Stop.NO_LOWER_COST),
        ([[float("nan"), 1.0]], TIGHT, Stop.NOT_FINITE),
    ],
)
def test_the_reason_for_stopping_is_told(start: list[list[float]], policy: Policy, reason: Stop) -> None:
    end = run(valley(), start, policy)
    assert end.reasons == [reason]
    assert end.converged == (reason in (Stop.CONVERGED, Stop.NO_LOWER_COST))
    if policy.steps is not None:
        assert int(end.accepted[0]) == policy.steps


def test_a_caller_may_end_a_descent() -> None:
    problem = valley()
    point = Point(values=tensor([[-1.2, 1.0]]))
    end = descend(problem, point, TIGHT, lambda iteration, _: iteration == 4)
    assert end.reasons == [Stop.WATCHER] and len(end.history) == 6


def test_a_group_that_diverges_ends_no_other() -> None:
    problem = decays([[2.0, 0.5, 0.1], [1.0, 3.0, -0.2]])
    end = run(problem, [[1.0, 1.0, 0.0], [float("inf"), 1.0, 0.0]])
    assert end.reasons == [Stop.CONVERGED, Stop.NOT_FINITE]
    assert end.point.values[0].tolist() == pytest.approx([2.0, 0.5, 0.1], abs=1e-6)


class Guarded(Curves):
    """Curves that refuse to be evaluated where a parameter is not finite, as a simulation does."""

    def rows(self, point: Point, rows: Rows) -> Tensor:
        assert bool(point.values.isfinite().all())
        return super().rows(point, rows)


def test_nothing_is_evaluated_at_a_step_that_is_not_finite() -> None:
    """Squares of slopes of 1e200 overflow, and no damping makes the equations regular."""

    def steep(x: Tensor) -> Tensor:
        return (x[:1] + x[1:]) * torch.where(x[:1] < 1, tensor(1e200), 1.0)

    measured = tensor([[0.0], [9.0]])
    end = run(Guarded(steep, measured, Box.unbounded(measured.expand(2, 2))), [[1e-300, 0.0], [3.0, 2.0]])
    assert end.point.values[0].tolist() == [1e-300, 0.0]
    assert float(end.point.values[1].sum()) == pytest.approx(9.0)


class Anchored(Problem):
    """States that measure themselves, one in each group."""

    def __init__(self, goal: Tensor) -> None:
        self.goal, self.owner, self.units = goal, torch.arange(len(goal)), torch.ones(1, dtype=F64)
        self.box = Box.unbounded(torch.zeros(len(goal), 0, dtype=F64))

    def linearised(self, point: Point, rows: Rows) -> NormalEquations:
        found = point.states[0] - self.goal[rows.items]
        return NormalEquations.of_rows(found, torch.ones(len(found), 1, 1, dtype=F64), 0, found.square().sum(1))


def test_steps_of_states_are_limited_and_small_ones_end_a_descent() -> None:
    problem = Anchored(tensor([[0.3], [2.0]]))
    start = Point(values=torch.zeros(2, 0, dtype=F64), states=(torch.zeros(2, 1, dtype=F64),))
    policy = Policy(iterations=50, damping=0.0, least_damping=0.0, attempts=1, step_limit=0.5, small_step=0.4)
    end = descend(problem, start, policy)
    assert end.reasons == [Stop.SMALL_STEP, Stop.NO_LOWER_COST]
    assert end.accepted.tolist() == [1, 4]
    assert end.point.states[0][:, 0].tolist() == pytest.approx([0.3, 2.0])


def test_damping_multiplies_a_least_information() -> None:
    matrix = torch.diag(torch.tensor([4.0, 0.01], dtype=torch.float64))[None]
    found = damped(matrix, torch.tensor([0.5], dtype=torch.float64), floor=0.2)
    assert found[0].diagonal().tolist() == pytest.approx([6.0, 0.11])
