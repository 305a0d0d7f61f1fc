"""Chains of tied segments: their states eliminated chain by chain give the step of the dense normal equations."""

import torch
from cgwm.pipeline.phys_geo.tracks.shooting_segments import Chains
from helpers.worlds import F64

PARAMETERS, STATE = 2, 3
FOLLOWING = torch.tensor([1, 2, -1, -1, 5, -1])


def normal(rows: torch.Tensor, jacobian: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return jacobian.mT @ jacobian, (jacobian.mT @ rows[..., None])[..., 0]


def test_chains_eliminated_one_by_one_give_the_step_of_all_segments_at_once() -> None:
    generator = torch.Generator().manual_seed(0)
    batch = len(FOLLOWING)
    rows, jacobian, ties, leading = (
        torch.randn(*shape, generator=generator, dtype=F64)
        for shape in (
            (batch, 7),
            (batch, 7, PARAMETERS + STATE),
            (batch, STATE),
            (batch, STATE, PARAMETERS + 2 * STATE),
        )
    )
    tied, prior = FOLLOWING >= 0, torch.tensor([0.5, 0.1, 2.0], dtype=F64)
    ties, leading = ties * tied[:, None], leading * tied[:, None, None]
    own, tie = normal(rows, jacobian), normal(ties, leading)
    total = PARAMETERS + batch * STATE
    matrix, slope = torch.zeros(total, total, dtype=F64), torch.zeros(total, dtype=F64)
    for row, after in enumerate(FOLLOWING.tolist()):
        state = torch.arange(STATE) + PARAMETERS + row * STATE
        here = torch.cat([torch.arange(PARAMETERS), state])
        there = torch.cat([here, torch.arange(STATE) + PARAMETERS + max(after, 0) * STATE])
        matrix[state, state] += prior
        for place, (block, pull) in ((here, own), (there, tie)):
            matrix[place[:, None], place] += block[row]
            slope[place] += pull[row]
    dense = torch.linalg.solve(matrix, -slope)
    chains = Chains.of(FOLLOWING)
    equations = chains.normal_equations(own, tie, prior, torch.arange(batch, dtype=F64))
    reduced = equations.eliminated()
    shared = torch.linalg.solve(reduced.information.sum(0), reduced.score.sum(0))
    states = reduced.following(shared.expand(len(reduced.score), -1)).unflatten(1, (-1, STATE))
    torch.testing.assert_close(shared, dense[:PARAMETERS])
    torch.testing.assert_close(chains.by_segment(states), dense[PARAMETERS:].view(batch, STATE))
    assert equations.cost.tolist() == [0 + 1 + 2, 4 + 5 + 3]  # the chains of two and of one share a row
