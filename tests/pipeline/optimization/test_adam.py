"""Adam against torch's class, to the bit, with tensors that have no gradient at times; its state goes on elsewhere."""

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


def test_steps_are_those_of_torch_and_go_on_from_a_state() -> None:
    mine, theirs = tensors(), tensors()
    groups = [[{"params": one[:2], "lr": 0.1}, {"params": one[2:], "lr": 0.01}] for one in (mine, theirs)]
    own, other = Adam(groups[0], eps=1e-12), torch.optim.Adam(groups[1], eps=1e-12)
    decay = torch.optim.lr_scheduler.ExponentialLR(other, 0.9)
    for step in range(8):
        if step == 4:
            state, own = own.state_dict(), Adam(groups[0], eps=1e-12)
            own.load_state_dict(state)
        give_gradients(mine, step)
        give_gradients(theirs, step)
        own.step()
        own.decay(0.9)
        other.step()
        decay.step()
        assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))
