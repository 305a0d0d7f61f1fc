"""Fit of a scene with an adaptive set of spheres, up to a budget.

3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591): noise moves faint spheres,
those that have become transparent move to where others are opaque, and the number grows to the budget. A split
preserves the picture: exactly in the opacities, on average in the scales.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from ....datasets.io.progress import progress
from ....datasets.shapes.ply import SH_C0
from ...geometry.spheres import Spheres
from ...geometry.spherical_harmonics import term_count
from ...optimization.adam import Adam
from ...rendering.image_metrics import psnr_of
from ...runtime.checkpoint import Slot, State
from ..photos.camera_refinement import Motions
from ..photos.photo_exposure import Exposures
from ..photos.views import View
from .losses import Loss
from .optimize import require_finite

DEAD = 0.005
"""Opacity below which a sphere is dead and moves to a living one."""
REFINED_EVERY = 100
REFINED_FROM, REFINED_UNTIL = 0.07, 0.85
"""Shares of the iterations between which dead spheres move and new ones are added."""
GROWTH = 1.05
NOISE = 5e5
MOST_COPIES = 51
OPACITY_WEIGHT = SCALE_WEIGHT = 0.01
"""Weights of the mean opacity and of the mean scale (in units of the cameras' spread), which remove spheres."""
RATES = {"means": 1.6e-4, "log_scales": 5e-3, "logits": 5e-2, "colors": 2.5e-3 * SH_C0, "harmonics": 1.25e-4}
"""Step sizes of Adam; that of the means is in units of the cameras' spread and falls to a hundredth."""


@dataclass(frozen=True)
class Progress:
    """Progress of a fit."""

    iteration: int
    """Number of the iteration, from 0."""
    spheres: int
    """Number of spheres."""
    loss: float
    """Mean loss since the last entry [1]."""
    psnr_db: float
    """PSNR of the last photo [dB]."""


class Population:
    """Spheres in the coordinates of the optimiser, in a number that may change.

    Args:
        spheres: The initial spheres.
        degree: Degree of the harmonics of the colours, 0 to 3.
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
            name: Adam([{"params": [value], "lr": self._rate(name)}], eps=1e-15, fused=value.is_cuda)
            for name, value in self._values.items()
            if value.numel()
        }

    def __len__(self) -> int:
        return len(self._values["means"])

    def spheres(self) -> Spheres:
        """Return the current spheres, differentiable with respect to the optimised coordinates."""
        value = self._values
        higher = value["harmonics"] if value["harmonics"].shape[1] else None
        return Spheres(
            means=value["means"],
            scales=value["log_scales"].exp(),
            opacities=torch.sigmoid(value["logits"]),
            colors=value["colors"],
            harmonics=higher,
        )

    def state(self) -> State:
        """Return the state of the spheres and of Adam, for a checkpoint."""
        return {
            "values": {name: value.detach() for name, value in self._values.items()},
            "adam": {name: adam.state_dict() for name, adam in self._adam.items()},
        }

    def restore(self, state: State) -> None:
        """Restore what `state` returned; the number of spheres may differ from the initial one."""
        for name, value in state["values"].items():
            self._values[name] = value.requires_grad_()
            if name in self._adam:
                self._adam[name].param_groups[0]["params"] = [self._values[name]]
                self._adam[name].load_state_dict(state["adam"][name])

    def step(self, share: float, generator: torch.Generator) -> None:
        """Move by the gradients and by noise, when `share` of the fit is over."""
        rate = self._rate("means") * 0.01**share
        self._adam["means"].param_groups[0]["lr"] = rate
        for adam in self._adam.values():
            adam.step()
            adam.zero_grad()
        with torch.no_grad():
            faint = torch.sigmoid(100 * (DEAD - torch.sigmoid(self._values["logits"])))
            reach = self._values["log_scales"].exp().square() * faint * NOISE * rate
            means = self._values["means"]
            means += reach[:, None] * torch.randn(means.shape, generator=generator, device=means.device)

    @torch.no_grad()
    def refine(self, budget: int, generator: torch.Generator) -> None:
        """Move dead spheres to living ones, and add new ones up to the budget."""
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
        """Split each source into equal spheres, one per mention and itself, which replace the targets or are new."""
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
        """Replace a parameter tensor and Adam's moments; the moments of forgotten rows are 0."""
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
    """Return opacity and scale (n,) of each of `copies` (n,) equal spheres that replace one, arXiv 2404.09591, eq. 9.

    Both the alpha of a ray through the centre, 1 - (1 - new)^copies = old, and the integral of alpha over a line across
    it are preserved.
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
    loss: Loss,
    *,
    budget: int,
    degree: int,
    iterations: int,
    spread: float,
    seed: int,
    what: str,
    exposures: Exposures,
    motions: Motions | None = None,
    slot: Slot | None = None,
) -> tuple[Spheres, list[Progress]]:
    """Fit an adaptive set of spheres to photos, one photo per iteration.

    Args:
        start: The initial spheres, at most `budget`.
        views: The photos; each round goes through all of them in a new order.
        loss: The loss of one view, including bodies in front of the spheres.
        budget: Maximum number of spheres.
        degree: Degree of the harmonics of the colours.
        iterations: Number of steps.
        spread: Greatest distance of a camera from their mean [m].
        seed: Seed.
        what: Name of the stage, for the progress bar.
        exposures: The photos' exposures that the loss learns, kept in checkpoints.
        motions: The motions of the cameras that it learns.
        slot: The checkpoint file, from which an interrupted fit resumes.

    Returns:
        The spheres, and the progress every `REFINED_EVERY` iterations.

    Raises:
        NotConvergedError: If the loss or a sphere is no longer finite.
    """
    run = _Run(Population(start, degree, spread), exposures, motions, seed)
    first = run.restore(slot)
    bar = progress(range(first, iterations), what, total=iterations, initial=first)
    for iteration in bar:
        view = views[run.next_photo(len(views))]
        spheres = run.population.spheres()
        value, wrong = loss(spheres, view, run.shuffle)
        value = value + OPACITY_WEIGHT * spheres.opacities.mean() + SCALE_WEIGHT * spheres.scales.mean() / spread
        run.step(value, iteration / iterations)
        if iteration % REFINED_EVERY == 0 or iteration == iterations - 1:
            require_finite(run.losses, iteration, iterations, what)
            run.note(iteration, wrong)
            bar.set_postfix_str(run.summary())
            if REFINED_FROM * iterations <= iteration < REFINED_UNTIL * iterations:
                run.population.refine(budget, run.noise)
            if slot is not None and slot.due():
                slot.write(run.state(iteration + 1))
    fitted = _detached(run.population.spheres())
    total = fitted.means.sum() + fitted.scales.sum() + fitted.colors.sum()
    require_finite([total], iterations - 1, iterations, what)
    return fitted, run.history


def _detached(spheres: Spheres) -> Spheres:
    """Return the spheres without their gradients."""
    higher = None if spheres.harmonics is None else spheres.harmonics.detach()
    plain = (spheres.means, spheres.scales, spheres.opacities, spheres.colors)
    return Spheres(*(tensor.detach() for tensor in plain), harmonics=higher)


class _Run:
    """State of a fit that passes from one iteration to the next."""

    def __init__(self, population: Population, exposures: Exposures, motions: Motions | None, seed: int) -> None:
        self.population, self.exposures, self.motions = population, exposures, motions
        self.shuffle = torch.Generator().manual_seed(seed)
        self.noise = torch.Generator(population.spheres().means.device).manual_seed(seed)
        self.order: list[int] = []
        self.losses: list[Tensor] = []
        self.history: list[Progress] = []

    def next_photo(self, count: int) -> int:
        self.order = self.order or torch.randperm(count, generator=self.shuffle).tolist()
        return self.order.pop()

    def step(self, value: Tensor, share: float) -> None:
        """Move against the gradient of a loss when `share` of the fit is over, and record the loss."""
        value.backward()
        self.losses.append(value.detach())
        self.population.step(share, self.noise)
        if self.motions is not None:
            self.motions.step(share)

    def note(self, iteration: int, wrong: Tensor) -> None:
        """Add an entry to the history from the losses since the last one and a mean square error."""
        mean = float(torch.stack(self.losses).mean())
        self.history.append(Progress(iteration, len(self.population), mean, psnr_of(wrong)))
        self.losses = []

    def summary(self) -> str:
        """Return the last entry of the history, for the progress bar."""
        last = self.history[-1]
        return f"{last.spheres} spheres, loss {last.loss:.4f}, {last.psnr_db:.1f} dB"

    def state(self, done: int) -> State:
        return {
            "done": done,
            "population": self.population.state(),
            "exposures": self.exposures.state(),
            "motions": None if self.motions is None else self.motions.state(),
            "shuffle": self.shuffle.get_state(),
            "noise": self.noise.get_state(),
            "order": self.order,
            "history": [asdict(entry) for entry in self.history],
        }

    def restore(self, slot: Slot | None) -> int:
        """Restore the last checkpoint; return the number of completed iterations."""
        state = slot.read(self.noise.device) if slot is not None else None
        if state is None:
            return 0
        self.population.restore(state["population"])
        self.exposures.restore(state["exposures"])
        if self.motions is not None:
            self.motions.restore(state["motions"])
        self.shuffle.set_state(state["shuffle"].cpu())
        self.noise.set_state(state["noise"].cpu())
        self.order = state["order"]
        self.history = [Progress(**entry) for entry in state["history"]]
        return state["done"]
