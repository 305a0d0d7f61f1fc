"""Fit of spheres to photos by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ....datasets.io.progress import progress
from ....schemas import NotConvergedError
from ...geometry.spheres import Spheres
from ...optimization.adam import Adam
from ...rendering.image_metrics import psnr_of
from ...runtime.checkpoint import Slot, State
from ..photos.camera_refinement import Motions
from ..photos.photo_exposure import Exposures
from ..photos.views import View
from .losses import Loss

_CHECK_INTERVAL = 20
"""Number of iterations between two checks that the loss is finite."""
_MAX_OPACITY = 0.995


@dataclass(frozen=True)
class Rates:
    """Step sizes of Adam; 0 freezes a quantity."""

    means: float = 0.0
    """Step size of the means, in units of each sphere's initial scale."""
    log_scales: float = 0.0
    """Step size of the logarithms of the scales [1]."""
    logits: float = 0.0
    """Step size of the logits of the opacities [1]."""
    colors: float = 0.0
    """Step size of the colours [1]."""


class Trainable:
    """Spheres in the coordinates of the optimiser.

    Means are in units of the initial scales, scales are logarithms, opacities are logits.
    """

    def __init__(self, spheres: Spheres, rates: Rates) -> None:
        self._start = spheres
        self.shift = torch.zeros_like(spheres.means)
        self.log_scale = torch.zeros_like(spheres.scales)
        self.logit = torch.logit(spheres.opacities / _MAX_OPACITY, 1e-4)
        self.colors = spheres.colors.clone()
        groups = [
            (self.shift, rates.means),
            (self.log_scale, rates.log_scales),
            (self.logit, rates.logits),
            (self.colors, rates.colors),
        ]
        for tensor, rate in groups:
            tensor.requires_grad_(rate > 0)
        self.groups = [{"params": [tensor], "lr": rate} for tensor, rate in groups if rate > 0]

    def spheres(self) -> Spheres:
        """Return the current spheres, differentiable with respect to the optimised coordinates."""
        start = self._start
        return Spheres(
            start.means + self.shift * start.scales[:, None],
            start.scales * self.log_scale.exp(),
            _MAX_OPACITY * torch.sigmoid(self.logit),
            self.colors.clamp(0, 1),
        )

    def state(self) -> State:
        """Return the state of the spheres, for a checkpoint."""
        start = self._start
        tensors = (start.means, start.scales, start.opacities, start.colors)
        moving = (self.shift, self.log_scale, self.logit, self.colors)
        return {"start": list(tensors), "moving": [tensor.detach() for tensor in moving]}

    @torch.no_grad()
    def restore(self, state: State) -> None:
        """Restore what `state` returned."""
        self._start = Spheres(*state["start"])
        for tensor, value in zip((self.shift, self.log_scale, self.logit, self.colors), state["moving"], strict=True):
            tensor.copy_(value)

    def drift(self) -> Tensor:
        """Return the drift of the geometry from its start: mean square of shifts and logarithms of scales [1]."""
        return self.shift.square().sum(1).mean() + self.log_scale.square().mean()


def descend(
    trainable: Trainable,
    views: Sequence[View],
    loss: Loss,
    iterations: int,
    seed: int,
    what: str,
    drift_weight: float = 0.0,
    exposures: Exposures | None = None,
    motions: Motions | None = None,
    slot: Slot | None = None,
) -> list[float]:
    """Minimise a loss with Adam, one view per iteration, with step sizes that fall to a tenth.

    Args:
        trainable: The spheres to optimise.
        views: The photos; each round goes through all of them in a new order.
        loss: The loss of one view.
        iterations: Number of steps.
        seed: Seed.
        what: Name of the stage, for the progress bar.
        drift_weight: Weight of `Trainable.drift`.
        exposures: The photos' exposures that the loss learns, kept in checkpoints.
        motions: The motions of the cameras that it learns.
        slot: The checkpoint file, from which an interrupted descent resumes.

    Returns:
        The loss by iteration.

    Raises:
        NotConvergedError: If the loss or a sphere is no longer finite.
    """
    run = _Run(trainable, exposures, motions, iterations, seed)
    first = run.restore(slot)
    bar = progress(range(first, iterations), what, total=iterations, initial=first)
    for iteration in bar:
        value, wrong = loss(trainable.spheres(), views[run.next_photo(len(views))], run.generator)
        if drift_weight > 0:
            value = value + drift_weight * trainable.drift()
        run.step(value, iteration / iterations)
        # On a GPU each check waits for the result, so the loss is not checked at every iteration.
        if iteration % _CHECK_INTERVAL == 0 or iteration == iterations - 1:
            require_finite(run.losses, iteration, iterations, what)
            bar.set_postfix_str(
                f"{len(trainable.shift)} spheres, loss {float(run.losses[-1]):.4f}, {psnr_of(wrong):.1f} dB"
            )
        if slot is not None and slot.due():
            require_finite(run.losses, iteration, iterations, what)
            slot.write(run.state())
    sums = [group["params"][0].detach().sum() for group in trainable.groups]
    require_finite([torch.stack(sums).sum()], iterations - 1, iterations, what)
    return torch.stack(run.losses).tolist()


class _Run:
    """State of a descent that passes from one iteration to the next."""

    def __init__(
        self,
        trainable: Trainable,
        exposures: Exposures | None,
        motions: Motions | None,
        iterations: int,
        seed: int,
    ) -> None:
        self.trainable, self.exposures, self.motions = trainable, exposures, motions
        self.generator = torch.Generator().manual_seed(seed)
        self.adam = Adam(trainable.groups, eps=1e-12)
        self.decay = 0.1 ** (1 / max(iterations, 1))
        self.losses: list[Tensor] = []
        self.order: list[int] = []

    def next_photo(self, count: int) -> int:
        """Return the index of the next of `count` photos; each round has a new order."""
        if not self.order:
            self.order = torch.randperm(count, generator=self.generator).tolist()
        return self.order.pop()

    def step(self, value: Tensor, share: float) -> None:
        """Move against the gradient of a loss when `share` of the descent is over, and record the loss."""
        self.adam.zero_grad()
        value.backward()
        self.adam.step()
        self.adam.decay(self.decay)
        if self.motions is not None:
            self.motions.step(share)
        self.losses.append(value.detach())

    def state(self) -> State:
        """Return the state, for a checkpoint."""
        return {
            "spheres": self.trainable.state(),
            "adam": self.adam.state_dict(),
            "generator": self.generator.get_state(),
            "losses": torch.stack(self.losses),
            "order": self.order,
            "exposures": None if self.exposures is None else self.exposures.state(),
            "motions": None if self.motions is None else self.motions.state(),
        }

    def restore(self, slot: Slot | None) -> int:
        """Restore the last checkpoint; return the number of completed iterations."""
        state = slot.read(self.trainable.shift.device) if slot is not None else None
        if state is None:
            return 0
        self.trainable.restore(state["spheres"])
        self.adam.load_state_dict(state["adam"])
        self.generator.set_state(state["generator"].cpu())
        self.losses, self.order = list(state["losses"].unbind()), state["order"]
        for learned, name in ((self.exposures, "exposures"), (self.motions, "motions")):
            if learned is not None:
                learned.restore(state[name])
        return len(self.losses)


def require_finite(values: Sequence[Tensor], iteration: int, iterations: int, what: str) -> None:
    """Check that losses of successive iterations, or sums of parameters, are finite; the last is of `iteration`.

    Raises:
        NotConvergedError: If one is not finite.
    """
    wrong = (~torch.isfinite(torch.stack(list(values)))).nonzero()
    if len(wrong):
        step = iteration + 2 - len(values) + int(wrong[0])
        raise NotConvergedError(
            f"The fit of '{what}' diverged by step {step} of {iterations}: its loss or its spheres are not finite.",
            todo="check that cameras and photos belong together ('cgwm validate CAPTURE'), or try another --seed.",
        )


def detached(spheres: Spheres) -> Spheres:
    """Return the spheres without their gradients."""
    return Spheres(spheres.means.detach(), spheres.scales.detach(), spheres.opacities.detach(), spheres.colors.detach())


def thinned(losses: list[float], count: int = 50) -> list[float]:
    """Return the losses averaged over equal intervals of iterations, for the record."""
    parts = torch.tensor(losses, dtype=torch.float64).tensor_split(min(count, len(losses)))
    return [round(float(part.mean()), 6) for part in parts]
