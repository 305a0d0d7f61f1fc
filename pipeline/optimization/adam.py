"""Adam of tensors in groups with a step size each (Kingma and Ba, arXiv:1412.6980).

The steps are torch's own function. Its class `torch.optim.Adam` is not used, because making one loads torch's compiler,
which takes longer than many fits of a tensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

BETAS = (0.9, 0.999)
"""Memory of the mean of gradients and of their squares, as in the paper."""


class Adam:
    """Adam of groups of tensors; those without a gradient do not move.

    Args:
        groups: Tensors and step size of each group, with the keys "params" and "lr".
        eps: Number added to the root of the mean square.
        fused: Whether one kernel does the whole step; on a CUDA device alone.
    """

    def __init__(self, groups: Sequence[Mapping[str, Any]], eps: float = 1e-8, fused: bool = False) -> None:
        self.param_groups = [{"params": list(group["params"]), "lr": float(group["lr"])} for group in groups]
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        self._eps, self._fused = eps, fused

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for tensor in self._tensors:
            tensor.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move against the gradients."""
        for group in self.param_groups:
            moving = [tensor for tensor in group["params"] if tensor.grad is not None]
            for tensor in moving:
                if tensor not in self.state:
                    self.state[tensor] = self._fresh(tensor)
            kept = [self.state[tensor] for tensor in moving]
            if moving:
                adam(
                    moving,
                    [tensor.grad for tensor in moving],
                    [one["exp_avg"] for one in kept],
                    [one["exp_avg_sq"] for one in kept],
                    [],
                    [one["step"] for one in kept],
                    fused=self._fused or None,
                    amsgrad=False,
                    beta1=BETAS[0],
                    beta2=BETAS[1],
                    lr=group["lr"],
                    weight_decay=0.0,
                    eps=self._eps,
                    maximize=False,
                )

    def decay(self, factor: float) -> None:
        """Multiply all step sizes by a factor."""
        for group in self.param_groups:
            group["lr"] *= factor

    def state_dict(self) -> dict[str, Any]:
        """Return step sizes and moments by the number of their tensor, for a checkpoint."""
        numbers = {id(tensor): number for number, tensor in enumerate(self._tensors)}
        return {
            "state": {numbers[id(tensor)]: dict(one) for tensor, one in self.state.items()},
            "param_groups": [{"lr": group["lr"]} for group in self.param_groups],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for group, kept in zip(self.param_groups, state["param_groups"], strict=True):
            group["lr"] = kept["lr"]
        tensors = self._tensors
        self.state = {
            tensors[number]: {name: value.to(self._place(name, tensors[number])) for name, value in one.items()}
            for number, one in state["state"].items()
        }

    @property
    def _tensors(self) -> list[Tensor]:
        return [tensor for group in self.param_groups for tensor in group["params"]]

    def _fresh(self, tensor: Tensor) -> dict[str, Tensor]:
        """Return the moments before the first step."""
        step = torch.zeros((), device=self._place("step", tensor))
        return {"step": step, "exp_avg": torch.zeros_like(tensor), "exp_avg_sq": torch.zeros_like(tensor)}

    def _place(self, name: str, tensor: Tensor) -> torch.device:
        """Return the device of a moment; steps are counted on the CPU unless one kernel does all."""
        return torch.device("cpu") if name == "step" and not self._fused else tensor.device
