"""How much better further parameters predict first contacts of episodes that their estimate has not seen.

The fit of some parameters is linearised, with the further ones at their present values. One Gauss-Newton step from some
of the episodes then predicts the fall of the misfit of the others, without another rollout.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.capture.tracks import Episode
from ..optimization.tails import student_quantile
from ..physics.parameters import Parameter
from ..physics.world import World
from ..trajectories.track_noise import Noise
from .first_contact_fit import AFTER_S, error_factor, solved_windows, window_residuals
from .thresholds import SEGMENT_THRESHOLDS

Array = NDArray[np.float64]

LEAST_EPISODES = SEGMENT_THRESHOLDS.choice.least_episodes
"""Minimum number of episodes for a comparison."""
FOLDS = 5
"""Number of parts into which the episodes are divided."""


@dataclass(frozen=True, eq=False)
class HeldOutGain:
    """Fall of the misfit of each episode (E), predicted by an estimate from other episodes."""

    by_episode: Array
    """Half the fall of chi-square, shape (E,)."""
    misfit: float
    """Half the chi-square of all episodes before."""

    @property
    def share(self) -> float:
        """Fall as a share of the misfit."""
        return float(self.by_episode.sum()) / self.misfit

    @property
    def std_error(self) -> float:
        """Standard error of `share`."""
        count = len(self.by_episode)
        return float(self.by_episode.std(ddof=1)) * count**0.5 / self.misfit

    @property
    def beyond_chance(self) -> bool:
        """Whether the episodes agree that the misfit falls, by more than their scatter."""
        reach = student_quantile(1 - SEGMENT_THRESHOLDS.choice.level, len(self.by_episode) - 1)
        return self.share > reach * self.std_error

    @property
    def matters(self) -> bool:
        """Whether the misfit falls beyond chance, and by a visible share."""
        return self.beyond_chance and self.share > SEGMENT_THRESHOLDS.choice.least_share


def has_number(changes: Iterable[tuple[float, float | None]]) -> bool:
    """Return whether one of some estimates differs from its value before beyond its error, so that it is a number.

    Args:
        changes: Of each estimate its change, and its standard error, None where the data say nothing about it.
    """
    least = SEGMENT_THRESHOLDS.choice.least_errors
    return any(error is None or abs(change) >= least * error for change, error in changes)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLinearization:
    """Quadratic approximation of the misfit of the first contacts of episodes (E) in parameters (P), no states."""

    names: tuple[str, ...]
    """Names of the parameters: first those that were fitted, then the further ones."""
    base: int
    """Number of parameters that were fitted."""
    information: Array
    """Information of each episode, without priors, shape (E, P, P)."""
    score: Array
    """Negative gradient of half the misfit of each episode, shape (E, P)."""
    prior: tuple[Array, Array]
    """Distance from the centre of the prior, and its information, each of shape (P,)."""
    excess: float
    """Ratio of the variance of the residuals to the assumed one, with their correlation in time."""
    misfit: float
    """Half the robust chi-square of all episodes."""

    @staticmethod
    def of(
        world: World,
        episodes: Sequence[Episode],
        base: Sequence[tuple[Parameter, float]],
        further: Sequence[tuple[Parameter, float]],
        noise: Noise,
    ) -> ContactLinearization:
        """Fit the base parameters to windows of flight and first contact, and linearise in the further ones, too.

        Args:
            world: The world, with effects whose parameters are among the further ones at their neutral values.
            episodes: Name and tracks by body of each episode.
            base: Parameters that are fitted, and their start.
            further: Further parameters, and their present values.
            noise: Standard deviations of the tracks (position [m], rotation [rad]).

        Raises:
            NotConvergedError: If the rollouts diverge at the start.
        """
        like = world.gravity
        names = [parameter for parameter, _ in (*base, *further)]
        coordinates = torch.tensor([p.encode(value) for p, value in (*base, *further)]).to(like)
        centre = torch.tensor([p.encode(p.prior[0]) for p in names]).to(like)
        held = torch.tensor([1 / p.prior[1] ** 2 for p in names]).to(like)
        count = len(base)
        residuals = window_residuals(world, episodes, names[:count], noise, None, AFTER_S)
        prior = (centre[:count], held[:count])
        fitted = solved_windows(residuals, coordinates[:count], None, prior)
        factor, _ = error_factor(residuals, fitted)
        start = torch.cat([fitted.shared, coordinates[count:]])
        wider = window_residuals(world, episodes, names, noise, None, AFTER_S)
        linear = solved_windows(wider, start, fitted.states, (centre, held), 0)
        return ContactLinearization(
            names=tuple(p.name for p in names),
            base=count,
            information=linear.by_item.numpy(),
            score=linear.scores.numpy(),
            prior=((start - centre).numpy(), held.numpy()),
            excess=factor,
            misfit=fitted.cost / 2,
        )

    def gain(self, columns: Sequence[int], over: Sequence[int] = ()) -> HeldOutGain:
        """Return what further parameters gain on held-out episodes.

        Args:
            columns: Their indices.
            over: Indices of the further parameters that the comparison has instead.
        """
        episode = np.arange(len(self.score))
        gain = np.zeros(len(episode))
        for fold in range(FOLDS):
            held_out = episode % FOLDS == fold
            gain[held_out] = self._fall(columns, held_out) - self._fall(over, held_out)
        return HeldOutGain(gain, self.misfit)

    def _fall(self, columns: Sequence[int], held_out: NDArray[np.bool_]) -> Array:
        """Return half the fall of the misfit of held-out episodes by a step from the others."""
        chosen = [*range(self.base), *columns]
        away, held = (value[chosen] for value in self.prior)
        information = self.information[:, chosen][:, :, chosen]
        score = self.score[:, chosen]
        rest = ~held_out
        step = np.linalg.solve(
            information[rest].sum(0) / self.excess + np.diag(held), score[rest].sum(0) / self.excess - held * away
        )
        return score[held_out] @ step - 0.5 * (information[held_out] @ step) @ step
