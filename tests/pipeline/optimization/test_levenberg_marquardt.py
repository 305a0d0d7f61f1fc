"""The fit of shared parameters and states where residuals are linear: the dense solution, and what is told of it."""

import pytest
import torch
from cgwm.pipeline.optimization.least_squares import Stop
from cgwm.pipeline.optimization.levenberg_marquardt import Solution, minimise, robust_loss
from cgwm.schemas import NotConvergedError
from torch import Tensor

F64 = torch.float64
ITEMS, FRAMES, PARTS, SHARED, STATES = 3, 7, 2, 2, 3
WIDE = torch.tensor([[-9.0, 9.0]] * SHARED, dtype=F64)


def drawn(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


JACOBIAN, TARGET = drawn(ITEMS, FRAMES, PARTS, SHARED + STATES, seed=1), drawn(ITEMS, FRAMES, PARTS, seed=2)


def residuals(shared: Tensor, states: Tensor, jacobian: bool) -> tuple[Tensor, Tensor | None]:
    all_of_it = torch.cat((shared.expand(len(states), -1), states), 1)
    found = torch.einsum("bfmc,bc->bfm", JACOBIAN, all_of_it) - TARGET
    return found, JACOBIAN if jacobian else None


def fitted(bounds: Tensor = WIDE, **more: object) -> Solution:
    start = torch.zeros(SHARED, dtype=F64), torch.zeros(ITEMS, STATES, dtype=F64)
    return minimise(residuals, *start, bounds, tolerance=1e-14, **more)  # pyright: ignore[reportArgumentType]


def dense() -> tuple[Tensor, Tensor]:
    """Return the matrix of all residuals by parameters and all states, and their targets."""
    rows = FRAMES * PARTS
    whole = torch.zeros(ITEMS, rows, SHARED + ITEMS * STATES, dtype=F64)
    for item in range(ITEMS):
        own = slice(SHARED + item * STATES, SHARED + (item + 1) * STATES)
        whole[item, :, :SHARED] = JACOBIAN[item, ..., :SHARED].reshape(rows, SHARED)
        whole[item, :, own] = JACOBIAN[item, ..., SHARED:].reshape(rows, STATES)
    return whole.reshape(-1, SHARED + ITEMS * STATES), TARGET.reshape(-1)


def test_the_solution_is_that_of_all_residuals_at_once() -> None:
    matrix, target = dense()
    best = torch.linalg.lstsq(matrix, target[:, None]).solution[:, 0]
    told: list[tuple[int, float]] = []
    found = fitted(on_iteration=lambda step, cost: told.append((step, cost)))
    torch.testing.assert_close(torch.cat((found.shared, found.states.flatten())), best, rtol=1e-6, atol=1e-8)
    left = (matrix @ best - target).square()
    assert found.cost == found.costs[-1] == pytest.approx(float(left.sum())) and found.converged
    assert found.costs[0] == pytest.approx(float(target.square().sum()))
    torch.testing.assert_close(found.chi2, left.view(ITEMS, FRAMES, PARTS).sum(-1), rtol=1e-5, atol=1e-8)
    assert told and told[-1][1] == pytest.approx(found.cost) and [step for step, _ in told] == sorted({*dict(told)})
    # information: the inverse of the shared block of the covariance of everything
    covariance = torch.linalg.inv(matrix.mT @ matrix)
    torch.testing.assert_close(found.information, torch.linalg.inv(covariance[:SHARED, :SHARED]), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.by_item.sum(0), found.information)
    states = JACOBIAN[..., SHARED:].flatten(1, 2)
    torch.testing.assert_close(found.state_cov, torch.linalg.inv(states.mT @ states))
    assert bool(found.free.all()) and float(found.scores.sum(0).abs().max()) < 1e-6 < float(found.scores.abs().max())


def test_priors_are_further_residuals() -> None:
    matrix, target = dense()
    centre, held = torch.tensor([0.5, -0.3], dtype=F64), torch.tensor([4.0, 9.0], dtype=F64)
    prior = torch.tensor([1.0, 0.0, 25.0], dtype=F64)
    more = torch.diag(torch.cat((held, prior.repeat(ITEMS))).sqrt())
    wanted = torch.cat((target, held.sqrt() * centre, torch.zeros(ITEMS * STATES, dtype=F64)))
    best = torch.linalg.lstsq(torch.cat((matrix, more)), wanted[:, None]).solution[:, 0]
    found = fitted(prior_information=prior, shared_prior=(centre, held))
    torch.testing.assert_close(torch.cat((found.shared, found.states.flatten())), best, rtol=1e-6, atol=1e-8)
    # the cost holds the states' prior, of each item its own; that of the parameters is none of the items'
    cost = (matrix @ best - target).square().sum() + (prior * found.states.square()).sum()
    told = fitted(prior_information=prior)
    own = (matrix @ torch.cat((told.shared, told.states.flatten())) - target).square().sum()
    assert told.cost == pytest.approx(float(own + (prior * told.states.square()).sum()))
    assert told.cost < float(cost) < float(TARGET.square().sum())
    each = fitted(prior_information=prior.expand(ITEMS, STATES), shared_prior=(centre, held))
    torch.testing.assert_close(each.shared, found.shared)
    # the prior of the parameters is no part of what the residuals say of them
    bare = fitted(prior_information=prior)
    torch.testing.assert_close(found.information, bare.information)


def test_a_parameter_on_its_bound_is_told_and_the_other_is_best_beside_it() -> None:
    matrix, target = dense()
    free = fitted().shared
    bounds = WIDE.clone()
    bounds[0, 1] = free[0] - 0.1
    found = fitted(bounds)
    assert found.free.tolist() == [False, True] and float(found.shared[0]) == float(bounds[0, 1])
    others = matrix[:, 1:]
    best = torch.linalg.lstsq(others, (target - matrix[:, 0] * bounds[0, 1])[:, None]).solution[:, 0]
    torch.testing.assert_close(torch.cat((found.shared[1:], found.states.flatten())), best, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("which", ["states", "shared"])
def test_either_kind_may_be_absent(which: str) -> None:
    only_states = which == "states"

    def part(shared: Tensor, states: Tensor, jacobian: bool) -> tuple[Tensor, Tensor | None]:
        mine = JACOBIAN[..., SHARED:] if only_states else JACOBIAN[..., :SHARED]
        values = states if only_states else shared.expand(ITEMS, -1)
        return torch.einsum("bfmc,bc->bfm", mine, values) - TARGET, mine if jacobian else None

    shared = torch.zeros(0 if only_states else SHARED, dtype=F64)
    states = torch.zeros(ITEMS, STATES if only_states else 0, dtype=F64)
    found = minimise(part, shared, states, WIDE[: len(shared)], tolerance=1e-14)
    assert found.state_cov.shape == (ITEMS, states.shape[1], states.shape[1])
    if only_states:
        for item in range(ITEMS):
            matrix = JACOBIAN[item, ..., SHARED:].flatten(0, 1)
            best = torch.linalg.lstsq(matrix, TARGET[item].flatten()[:, None]).solution[:, 0]
            torch.testing.assert_close(found.states[item], best, rtol=1e-6, atol=1e-8)
    else:
        best = torch.linalg.lstsq(JACOBIAN[..., :SHARED].flatten(0, 2), TARGET.flatten()[:, None]).solution[:, 0]
        torch.testing.assert_close(found.shared, best, rtol=1e-6, atol=1e-8)


def test_cauchys_loss_and_its_weight_are_value_and_slope() -> None:
    chi2 = torch.tensor([0.0, 0.5, 4.0, 1e4], dtype=F64, requires_grad=True)
    loss, weight = robust_loss(chi2, 3.0)
    torch.testing.assert_close(loss, 9 * torch.log(1 + chi2 / 9))
    (slope,) = torch.autograd.grad(loss.sum(), chi2)
    torch.testing.assert_close(weight, slope)
    plain, one = robust_loss(chi2.detach(), None)
    assert torch.equal(plain, chi2.detach()) and torch.equal(one, torch.ones(4, dtype=F64))


def test_a_model_that_diverges_at_the_start_and_few_iterations_are_told() -> None:
    def nowhere(shared: Tensor, states: Tensor, jacobian: bool) -> tuple[Tensor, Tensor | None]:
        found, slopes = residuals(shared, states, jacobian)
        return found * torch.nan, slopes

    start = torch.zeros(SHARED, dtype=F64), torch.zeros(ITEMS, STATES, dtype=F64)
    with pytest.raises(NotConvergedError, match="diverges already at the start"):
        minimise(nowhere, *start, WIDE)
    stopped = fitted(iterations=1)
    assert stopped.stop == Stop.ITERATIONS and not stopped.converged and len(stopped.costs) == 2
