"""Fitting spheres to photos by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...datasets.progress import progress
from ...schemas import NotConvergedError
from ..checkpoint import Slot, State
from .exposures import Exposures
from .losses import Loss, psnr_of
from .poses import Motions
from .spheres import Spheres
from .views import View

_LOOKED_EVERY = 20
_MAX_OPACITY = 0.995


@dataclass(frozen=True)
class Rates:
    """Adam's step sizes; 0 freezes a quantity.

    Attributes:
        means: In units of each sphere's own initial scale.
        log_scales: [1]
        logits: Of the opacities.
        colors: [1]
    """

    means: float = 0.0
    log_scales: float = 0.0
    logits: float = 0.0
    colors: float = 0.0


class Trainable:
    """Spheres in the coordinates that the optimiser moves in.

    Means move in units of the spheres' own scales, scales by their logarithm, opacities by their logit.
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
        """Return the spheres as they are now, connected to what is optimised."""
        start = self._start
        return Spheres(
            start.means + self.shift * start.scales[:, None],
            start.scales * self.log_scale.exp(),
            _MAX_OPACITY * torch.sigmoid(self.logit),
            self.colors.clamp(0, 1),
        )

    def state(self) -> State:
        """Return all that the spheres are made of, for a checkpoint."""
        start = self._start
        tensors = (start.means, start.scales, start.opacities, start.colors)
        moving = (self.shift, self.log_scale, self.logit, self.colors)
        return {"start": list(tensors), "moving": [tensor.detach() for tensor in moving]}

    @torch.no_grad()
    def restore(self, state: State) -> None:
        """Take up what `state` returned."""
        self._start = Spheres(*state["start"])
        for tensor, value in zip((self.shift, self.log_scale, self.logit, self.colors), state["moving"], strict=True):
            tensor.copy_(value)

    def drift(self) -> Tensor:
        """Return how far the geometry is from its start: mean square of shifts and logarithms of scales [1]."""
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
    """Run Adam, one view an iteration, with step sizes that fall to a tenth.

    Args:
        trainable: What moves.
        views: The photos; each round goes through all of them in a new order.
        loss: The loss of one view.
        iterations: Number of steps.
        seed: Seed.
        what: Name of the stage, for the progress bar.
        drift_weight: Weight of `Trainable.drift`.
        exposures: What the loss learns of the photos' exposures, to be kept in checkpoints.
        motions: What it learns of the cameras' poses.
        slot: Where checkpoints go, and from where an interrupted descent is taken up.

    Returns:
        The loss by iteration.

    Raises:
        NotConvergedError: If the loss or what moves is no longer finite.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(trainable.groups, eps=1e-12)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.1 ** (1 / max(iterations, 1)))
    losses: list[Tensor] = []
    order: list[int] = []
    state = slot.read(trainable.shift.device) if slot is not None else None
    if state is not None:
        trainable.restore(state["spheres"])
        optimiser.load_state_dict(state["adam"])
        decay.load_state_dict(state["decay"])
        generator.set_state(state["generator"].cpu())
        losses, order = list(state["losses"].unbind()), state["order"]
        for carried, name in ((exposures, "exposures"), (motions, "motions")):
            if carried is not None:
                carried.restore(state[name])
    bar = progress(range(len(losses), iterations), what, total=iterations, initial=len(losses))
    for iteration in bar:
        if not order:
            order = torch.randperm(len(views), generator=generator).tolist()
        value, wrong = loss(trainable.spheres(), views[order.pop()], generator)
        if drift_weight > 0:
            value = value + drift_weight * trainable.drift()
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        decay.step()
        if motions is not None:
            motions.step(iteration / iterations)
        losses.append(value.detach())
        # not oftener, for on a GPU a look waits until it is ready
        if iteration % _LOOKED_EVERY == 0 or iteration == iterations - 1:
            require_finite(losses, iteration, iterations, what)
            bar.set_postfix_str(
                f"{len(trainable.shift)} spheres, loss {float(losses[-1]):.4f}, {psnr_of(wrong):.1f} dB"
            )
        if slot is not None and slot.due():
            require_finite(losses, iteration, iterations, what)
            slot.write(
                {
                    "spheres": trainable.state(),
                    "adam": optimiser.state_dict(),
                    "decay": decay.state_dict(),
                    "generator": generator.get_state(),
                    "losses": torch.stack(losses),
                    "order": order,
                    "exposures": None if exposures is None else exposures.state(),
                    "motions": None if motions is None else motions.state(),
                }
            )
    sums = [group["params"][0].detach().sum() for group in trainable.groups]
    require_finite([torch.stack(sums).sum()], iterations - 1, iterations, what)
    return torch.stack(losses).tolist()


def require_finite(values: Sequence[Tensor], iteration: int, iterations: int, what: str) -> None:
    """Check losses of successive iterations, or sums of what moves, the last of which belongs to `iteration`.

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
    """Return the spheres apart from what optimised them."""
    return Spheres(spheres.means.detach(), spheres.scales.detach(), spheres.opacities.detach(), spheres.colors.detach())


def thinned(losses: list[float], count: int = 50) -> list[float]:
    """Return the losses averaged over equal stretches of iterations, for the record."""
    parts = torch.tensor(losses, dtype=torch.float64).tensor_split(min(count, len(losses)))
    return [round(float(part.mean()), 6) for part in parts]
