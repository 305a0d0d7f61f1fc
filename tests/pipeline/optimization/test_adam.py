"""Adam against its paper, with tensors that have no gradient at times; its state goes on elsewhere."""

from collections.abc import Sequence

import torch
from cgwm.pipeline.optimization.adam import Adam
from torch import Tensor


def tensors() -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(size, generator=generator).requires_grad_() for size in ((4, 3), (5,), (2,))]


def give_gradients(some: Sequence[Tensor], step: int) -> None:
    for number, one in enumerate(some):
        one.grad = None if step % 3 == number else torch.cos(one.detach() * (step + 1))


class Plain:
    """Adam of one tensor as in algorithm 1 of the paper, in double precision."""

    def __init__(self, tensor: Tensor) -> None:
        self.value = tensor.detach().double().clone()
        self.mean, self.square, self.steps = torch.zeros_like(self.value), torch.zeros_like(self.value), 0

    def step(self, gradient: Tensor, rate: float, eps: float) -> None:
        self.steps += 1
        self.mean = 0.9 * self.mean + 0.1 * gradient
        self.square = 0.999 * self.square + 0.001 * gradient.square()
        mean, square = self.mean / (1 - 0.9**self.steps), self.square / (1 - 0.999**self.steps)
        self.value = self.value - rate * mean / (square.sqrt() + eps)


def test_steps_are_those_of_the_paper_and_go_on_from_a_state() -> None:
    mine, plain = tensors(), [Plain(one) for one in tensors()]
    groups = [{"params": mine[:2], "lr": 0.1}, {"params": mine[2:], "lr": 0.01}]
    own = Adam(groups, eps=1e-3)
    for step in range(8):
        if step == 4:
            state, own = own.state_dict(), Adam(groups, eps=1e-3)
            own.load_state_dict(state)
        give_gradients(mine, step)
        for one, other, rate in zip(mine, plain, (0.1, 0.1, 0.01), strict=True):
            if one.grad is not None:
                other.step(one.grad.double(), rate * 0.9**step, 1e-3)
        own.step()
        own.decay(0.9)
        for one, other in zip(mine, plain, strict=True):
            torch.testing.assert_close(one.detach().double(), other.value, rtol=1e-5, atol=1e-6)
