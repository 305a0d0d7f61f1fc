"""Segments of multiple shooting in chains, and their normal equations by chain.

A tie couples the states of two neighbouring segments only, so that the states of a chain of tied segments are one item
of the least-squares solver, which eliminates them: systems of one chain instead of one of all segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...optimization.problem import NormalEquations


@dataclass(frozen=True, kw_only=True)
class Chains:
    """Segments (B) in chains (C) of up to M tied segments."""

    segment: Tensor
    """Segment at each place of each chain, 0 where there is none, shape (C, M)."""
    filled: Tensor
    """Whether there is a segment, shape (C, M)."""
    chain: Tensor
    """Chain of each segment, shape (B,)."""
    place: Tensor
    """Its place in the chain, shape (B,)."""

    @staticmethod
    def of(following: Tensor) -> Chains:
        """Return the chains of segments whose following segment (B,), -1 for none, is the next one."""
        chain, place = [], []
        joined = False
        for after in following.tolist():
            chain.append(chain[-1] if joined else len(set(chain)))
            place.append(place[-1] + 1 if joined else 0)
            joined = after >= 0
        rows, columns = torch.tensor(chain), torch.tensor(place)
        segment = torch.zeros(chain[-1] + 1, max(place) + 1, dtype=torch.long)
        filled = torch.zeros_like(segment, dtype=torch.bool)
        segment[rows, columns], filled[rows, columns] = torch.arange(len(chain)), True
        return Chains(segment=segment, filled=filled, chain=rows, place=columns)

    def by_chain(self, values: Tensor) -> Tensor:
        """Return values (B, ...) of segments by chain and place, shape (C, M, ...)."""
        return values[self.segment]

    def by_segment(self, values: Tensor) -> Tensor:
        """Return values (C, M, ...) by segment, shape (B, ...)."""
        return values[self.chain, self.place]

    def summed(self, values: Tensor) -> Tensor:
        """Return the sums (C, ...) of values (B, ...) of segments."""
        return values.new_zeros(len(self.segment), *values.shape[1:]).index_add(0, self.chain, values)

    def normal_equations(
        self, own: tuple[Tensor, Tensor], tie: tuple[Tensor, Tensor], prior: Tensor, cost: Tensor
    ) -> NormalEquations:
        """Return the normal equations of the chains, whose states are those of their segments (M S).

        Args:
            own: Information (B, P + S, P + S) and gradient (B, P + S) of the frames of each segment by parameters and
                its state.
            tie: The same of its tie by parameters, its state and the next one, shapes (B, P + 2 S, P + 2 S) and
                (B, P + 2 S); 0 where no segment follows.
            prior: Information added on the diagonal of each state, shape (S,).
            cost: Cost of each segment, shape (B,).
        """
        size = len(prior)
        count = own[1].shape[1] - size
        here, after = slice(count, count + size), slice(count + size, None)
        chains, length = self.segment.shape
        (matrix, slope), (coupled, pull) = own, tie
        both = slice(None, count + size)
        matrix, slope = matrix + coupled[:, both, both], slope + pull[:, both]
        place = (self.chain, self.place)
        tied = (self.filled[:, 1:], slice(1, None))
        states = matrix.new_zeros(chains, length, size, length, size)
        mixed, state_slope = matrix.new_zeros(chains, length, size, count), slope.new_zeros(chains, length, size)
        diagonal = torch.eye(size).to(matrix).repeat(chains, length, 1, 1)  # where there is no segment
        diagonal[place] = matrix[:, here, here] + torch.diag(prior)
        mixed[place], state_slope[place] = matrix[:, here, :count], slope[:, here]
        into = [self.by_chain(part)[:, :-1] * tied[0].view(chains, -1, *[1] * (part.dim() - 1)) for part in tie]
        diagonal[:, 1:] += into[0][:, :, after, after]
        mixed[:, 1:] += into[0][:, :, after, :count]
        state_slope[:, 1:] += into[1][:, :, after]
        step = torch.arange(length)
        states.movedim(3, 2)[:, step, step] = diagonal
        across = into[0][:, :, here, after]
        states.movedim(3, 2)[:, step[:-1], step[1:]] = across
        states.movedim(3, 2)[:, step[1:], step[:-1]] = across.mT
        return NormalEquations(
            states=states.flatten(3).flatten(1, 2),
            mixed=mixed.flatten(1, 2),
            information=self.summed(matrix[:, :count, :count]),
            state_slope=-state_slope.flatten(1),
            slope=-self.summed(slope[:, :count]),
            cost=self.summed(cost),
        )
