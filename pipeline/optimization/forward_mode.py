"""Exact Jacobians by forward-mode differentiation, all directions in one batched pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.overrides import TorchFunctionMode

_SCALAR_FORMS = {
    torch.Tensor.mul: torch.ops.aten.mul.Scalar,
    torch.Tensor.__mul__: torch.ops.aten.mul.Scalar,
    torch.Tensor.__rmul__: torch.ops.aten.mul.Scalar,
    torch.Tensor.add: torch.ops.aten.add.Scalar,
    torch.Tensor.__add__: torch.ops.aten.add.Scalar,
    torch.Tensor.__radd__: torch.ops.aten.add.Scalar,
    torch.Tensor.sub: torch.ops.aten.sub.Scalar,
    torch.Tensor.__sub__: torch.ops.aten.sub.Scalar,
    torch.Tensor.div: torch.ops.aten.div.Scalar,
    torch.Tensor.__truediv__: torch.ops.aten.div.Scalar,
}
"""Operations with a Python number, and their forms that need no tensor of it."""
_RECIPROCAL = {torch.Tensor.__rtruediv__, torch.Tensor.__rdiv__}
"""Divisions of a Python number by a tensor."""
_MIXED = {
    *_SCALAR_FORMS,
    torch.Tensor.__rsub__,
    *_RECIPROCAL,
    torch.Tensor.__matmul__,
    torch.Tensor.__rmatmul__,
    torch.atan2,
    torch.linalg.cross,
    torch.maximum,
    torch.minimum,
    torch.where,
}
"""Operations whose constant operands get a tangent of zeros."""


def dual_of(primal: Tensor, tangent: Tensor) -> Tensor:
    """Return a tensor with a forward derivative, as `forward_ad.make_dual` does.

    That one loads the decompositions of torch first, which takes 0.2 s and which none of our operations needs.
    """
    return torch._VF._make_dual(primal, tangent, level=0)


def parts_of(tensor: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return value and forward derivative, None without, as `forward_ad.unpack_dual` does in three times the time."""
    primal, tangent = torch._VF._unpack_dual(tensor, level=0)
    return primal, tangent


class _DenseTangents(TorchFunctionMode):
    """Give constants that are combined with differentiated tensors a tangent of zeros.

    Without one, torch 2.13 uses a symbolic zero and resolves every such operation in Python, which is 40 times slower
    for small tensors (250 against 6 microseconds for a product with a constant).
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in _MIXED:
            tensors = [x for x in args if isinstance(x, Tensor)]
            dual = [x.is_floating_point() and parts_of(x)[1] is not None for x in tensors]
            if any(dual):
                if isinstance(args[1], float | int):
                    if func in _SCALAR_FORMS:
                        return _SCALAR_FORMS[func](*args)
                    if func in _RECIPROCAL:
                        return torch.ops.aten.mul.Scalar(args[0].reciprocal(), args[1])
                if not all(dual):
                    like = tensors[dual.index(True)]
                    first = func is torch.where  # the condition stays what it is
                    lifted = (_lifted(x, like) if isinstance(x, Tensor) else x for x in args[first:])
                    args = (*args[:first], *lifted)
        return func(*args, **(kwargs or {}))


def _lifted(x: Tensor, like: Tensor) -> Tensor:
    """Return a tensor with a tangent of zeros if it has none; truth values and integers as numbers of a given type."""
    if not x.is_floating_point():
        x = x.to(like.dtype)
    elif parts_of(x)[1] is not None:
        return x
    dense = x.contiguous()  # an expanded view cannot carry a tangent
    return dual_of(dense, torch.zeros_like(dense))


def batched_jacobian(function: Callable[[Tensor, int], Tensor], inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return values and Jacobians of a function that treats the items of a batch independently.

    The batch is repeated once for each direction and evaluated in one forward-mode pass. Rollouts of small bodies are
    limited by the number of operations, not by their size, so all directions cost little more than one.

    Args:
        function: Maps inputs (K B, D) and the number of repeats K to outputs (K B, M).
        inputs: Shape (B, D).

    Returns:
        Values (B, M) and Jacobians (B, M, D).
    """
    batch, size = inputs.shape
    # in inference mode torch drops tangents without a word
    with torch.inference_mode(False), torch.no_grad(), forward_ad.dual_level(), _DenseTangents():
        repeated = inputs.detach().repeat(size, 1)
        tangent = torch.eye(size, dtype=inputs.dtype, device=inputs.device).repeat_interleave(batch, 0)
        output, derivative = parts_of(function(dual_of(repeated, tangent), size))
    value = output[:batch]
    if derivative is None:
        return value, value.new_zeros(batch, value.shape[1], size)
    return value, derivative.view(size, batch, -1).permute(1, 2, 0)
