"""Exact Jacobians by forward-mode differentiation, all directions in one batched pass."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import forward_ad


def batched_jacobian(function: Callable[[Tensor, int], Tensor], inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return values and Jacobians of a function that treats the items of a batch independently.

    The batch is repeated once for each direction and pushed through in one forward-mode pass: rollouts of small
    bodies are bound by the number of operations, not by their size, so all directions cost little more than one.

    Args:
        function: Maps inputs (K B, D) and the number of repeats K to outputs (K B, M).
        inputs: Shape (B, D).

    Returns:
        Values (B, M) and Jacobians (B, M, D).
    """
    batch, size = inputs.shape
    repeated = inputs.detach().repeat(size, 1)
    tangent = torch.eye(size, dtype=inputs.dtype, device=inputs.device).repeat_interleave(batch, 0)
    with torch.no_grad(), forward_ad.dual_level():
        output = forward_ad.unpack_dual(function(forward_ad.make_dual(repeated, tangent), size))
    value = output.primal[:batch]
    if output.tangent is None:
        return value, value.new_zeros(batch, value.shape[1], size)
    return value, output.tangent.view(size, batch, -1).permute(1, 2, 0)
