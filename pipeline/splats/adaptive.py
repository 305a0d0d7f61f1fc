"""Fitting a scene with spheres that go where they are needed, up to a budget.

3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591): spheres wander by noise
while they are faint, those that have become transparent move to where others are opaque, and the number grows to the
budget. A sphere that splits keeps the picture as it was, by its opacities exactly and by its scales on average.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...datasets.ply import SH_C0
from ...datasets.progress import progress
from .fit import photometric, psnr, require_finite
from .harmonics import term_count
from .spheres import Spheres
from .views import View

DEAD = 0.005
"""A sphere of less opacity is dead, and moves to where others live."""
REFINED_EVERY = 100
REFINED_FROM, REFINED_UNTIL = 0.07, 0.85
"""Shares of the iterations between which spheres move and multiply."""
GROWTH = 1.05
NOISE = 5e5
MOST_COPIES = 51
OPACITY_WEIGHT = SCALE_WEIGHT = 0.01
"""Weights of the mean opacity, and of the mean scale in units of the cameras' spread: they make spheres die."""
RATES = {"means": 1.6e-4, "log_scales": 5e-3, "logits": 5e-2, "colors": 2.5e-3 * SH_C0, "harmonics": 1.25e-4}
"""Adam's step sizes; of the means in units of the cameras' spread, falling to a hundredth."""


@dataclass(frozen=True)
class Progress:
    """How far a fit is: iteration, spheres, mean loss and PSNR [dB] of the last iterations."""

    iteration: int
    spheres: int
    loss: float
    psnr_db: float


class Population:
    """Spheres in the coordinates that Adam moves in, whose number may change.

    Args:
        spheres: The start.
        degree: Of the harmonics of the colours, 0 to 3.
        spread: Greatest distance of a camera from their mean [m].
    """

    def __init__(self, spheres: Spheres, degree: int, spread: float) -> None:
        self.spread = spread
        start = {
            "means": spheres.means,
            "log_scales": spheres.scales.log(),
            "logits": torch.logit(spheres.opacities, 1e-4),
            "colors": spheres.colors,
            "harmonics": spheres.colors.new_zeros(len(spheres), term_count(degree) - 1, 3),
        }
        self._values = {name: value.detach().clone().requires_grad_() for name, value in start.items()}
        self._adam = {
            name: torch.optim.Adam([value], self._rate(name), eps=1e-15, fused=value.is_cuda)
            for name, value in self._values.items()
            if value.numel()
        }

    def __len__(self) -> int:
        return len(self._values["means"])

    def spheres(self) -> Spheres:
        """Return the spheres as they are now, connected to what is optimised."""
        value = self._values
        higher = value["harmonics"] if value["harmonics"].shape[1] else None
        return Spheres(
            value["means"], value["log_scales"].exp(), torch.sigmoid(value["logits"]), value["colors"], higher
        )

    def step(self, share: float, generator: torch.Generator) -> None:
        """Move by the gradients, and by noise; `share` of the fit is over."""
        rate = self._rate("means") * 0.01**share
        self._adam["means"].param_groups[0]["lr"] = rate
        for adam in self._adam.values():
            adam.step()
            adam.zero_grad(set_to_none=True)
        with torch.no_grad():
            faint = torch.sigmoid(100 * (DEAD - torch.sigmoid(self._values["logits"])))
            reach = self._values["log_scales"].exp().square() * faint * NOISE * rate
            means = self._values["means"]
            means += reach[:, None] * torch.randn(means.shape, generator=generator, device=means.device)

    @torch.no_grad()
    def refine(self, budget: int, generator: torch.Generator) -> None:
        """Move dead spheres to living ones, and add some up to the budget."""
        opacity = torch.sigmoid(self._values["logits"])
        dead = (opacity <= DEAD).nonzero()[:, 0]
        alive = (opacity > DEAD).nonzero()[:, 0]
        if len(alive) == 0:
            return
        if len(dead):
            self._split(alive[torch.multinomial(opacity[alive], len(dead), True, generator=generator)], dead)
        more = min(budget, int(GROWTH * len(self)) + 1) - len(self)
        if more > 0:
            opacity = torch.sigmoid(self._values["logits"])
            self._split(torch.multinomial(opacity, more, True, generator=generator), None)

    def _rate(self, name: str) -> float:
        return RATES[name] * (self.spread if name == "means" else 1.0)

    def _split(self, sources: Tensor, targets: Tensor | None) -> None:
        """Make of each source as many equal spheres as it is named times, and itself; in place of targets, or new."""
        copies = torch.bincount(sources, minlength=len(self)) + 1
        split = (copies > 1).nonzero()[:, 0]
        opacity, scale = torch.sigmoid(self._values["logits"][split]), self._values["log_scales"][split].exp()
        opacity, scale = shared_among(opacity, scale, copies[split])
        values = {name: value.detach().clone() for name, value in self._values.items()}
        values["logits"][split] = torch.logit(opacity.clamp(DEAD, 1 - 1e-6))
        values["log_scales"][split] = scale.log()
        for name, value in values.items():
            if targets is None:
                self._replace(name, torch.cat([value, value[sources]]), split)
            else:
                value[targets] = value[sources]
                self._replace(name, value, torch.cat([split, targets]))

    def _replace(self, name: str, value: Tensor, forgotten: Tensor) -> None:
        """Put a tensor in the place of another, with Adam's moments, which of forgotten rows are 0."""
        old, new = self._values[name], value.requires_grad_()
        self._values[name] = new
        adam = self._adam.get(name)
        if adam is None:
            return
        adam.param_groups[0]["params"] = [new]
        state = adam.state.pop(old, None)
        if state is None:
            return
        for key in ("exp_avg", "exp_avg_sq"):
            moments = state[key]
            added = moments.new_zeros(len(new) - len(moments), *moments.shape[1:])
            state[key] = torch.cat([moments, added])
            state[key][forgotten] = 0
        adam.state[new] = state


def shared_among(opacity: Tensor, scale: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale (n,) of each of `copies` (n,) equal spheres that stand for one, arXiv 2404.09591, eq. 9.

    The alpha of a ray through the centre stays, 1 - (1 - new)^copies = old, and so does the integral of alpha over a
    line across it.
    """
    copies = copies.clamp_max(MOST_COPIES)
    new = 1 - (1 - opacity.double()) ** (1 / copies.double())
    # sum over i <= copies and k < i of C(i - 1, k) (-1)^k new^(k + 1) / sqrt(k + 1), with C summed over i first
    total = torch.zeros_like(new)
    for k in range(int(copies.max())):
        weight = _binomial(copies.double(), k + 1)
        total += torch.where(copies > k, weight * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1), 0.0)
    return new.to(opacity), (scale.double() * opacity / total).to(scale)


def _binomial(n: Tensor, k: int) -> Tensor:
    """Return C(n, k), (n,)."""
    return torch.exp(torch.lgamma(n + 1) - math.lgamma(k + 1) - torch.lgamma((n - k).clamp_min(0.0) + 1))


def fit_adaptively(
    start: Spheres,
    views: Sequence[View],
    picture: Callable[[Spheres, View], Tensor],
    *,
    budget: int,
    degree: int,
    iterations: int,
    spread: float,
    seed: int,
    what: str,
) -> tuple[Spheres, list[Progress]]:
    """Fit spheres to photos, one photo an iteration.

    Args:
        start: The spheres at the beginning, at most the budget.
        views: The photos; each round goes through all of them in a new order.
        picture: Renders the spheres as a view sees them (H, W, 3), with whatever stands before them.
        budget: Most spheres.
        degree: Of the harmonics of the colours.
        iterations: Number of steps.
        spread: Greatest distance of a camera from their mean [m].
        seed: Seed.
        what: Name of the stage, for the progress bar.

    Returns:
        The spheres, and how it went, every `REFINED_EVERY` iterations.

    Raises:
        NotConvergedError: If the loss or a sphere is no longer finite.
    """
    population = Population(start, degree, spread)
    shuffle = torch.Generator().manual_seed(seed)
    noise = torch.Generator(start.means.device).manual_seed(seed)
    history: list[Progress] = []
    order: list[int] = []
    losses: list[Tensor] = []
    bar = progress(range(iterations), what)
    for iteration in bar:
        if not order:
            order = torch.randperm(len(views), generator=shuffle).tolist()
        view = views[order.pop()]
        spheres = population.spheres()
        seen = picture(spheres, view)
        value = photometric(seen, view.image)
        value = value + OPACITY_WEIGHT * spheres.opacities.mean() + SCALE_WEIGHT * spheres.scales.mean() / spread
        value.backward()
        losses.append(value.detach())
        population.step(iteration / iterations, noise)
        if iteration % REFINED_EVERY == 0 or iteration == iterations - 1:
            mean = float(torch.stack(losses).mean())
            require_finite(mean, what, f"{iteration + 1} of {iterations}")
            history.append(Progress(iteration, len(population), mean, psnr(seen.detach(), view.image)))
            losses = []
            bar.set_postfix_str(f"{len(population)} spheres, loss {mean:.4f}, {history[-1].psnr_db:.1f} dB")
            if REFINED_FROM * iterations <= iteration < REFINED_UNTIL * iterations:
                population.refine(budget, noise)
    fitted = population.spheres()
    require_finite(float((fitted.means.sum() + fitted.colors.sum()).detach()), what, f"{iterations} of {iterations}")
    higher = None if fitted.harmonics is None else fitted.harmonics.detach()
    plain = (fitted.means, fitted.scales, fitted.opacities, fitted.colors)
    return Spheres(*(tensor.detach() for tensor in plain), harmonics=higher), history
