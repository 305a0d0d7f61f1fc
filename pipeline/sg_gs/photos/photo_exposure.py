"""Exposure and white balance of the photos, learned while spheres are fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ...runtime.checkpoint import State
from .views import View

_FOLLOWING = 0.3
"""Share of the way to the least-squares gain that the gain of a photo moves each time the photo is rendered."""
_LEAST, _MOST = 0.1, 10.0
_FEWEST = 3
"""Fewest fitted photos that tell the exposure of another."""


class Exposures:
    """A gain of each colour channel for each photo: photo = gain * render.

    The best gain for the current spheres is a least-squares factor, so no descent is needed: whenever a photo is
    rendered, its gain moves part of the way there. The geometric mean of the gains stays 1, because photos cannot
    distinguish a bright scene from a long exposure.

    Args:
        views: The photos.
        learned: Whether gains are learned; otherwise all stay 1.
    """

    def __init__(self, views: Sequence[View], learned: bool) -> None:
        self.learned = learned
        self._place = {view.name: k for k, view in enumerate(views)}
        self._log_gains = views[0].image.new_zeros(len(views), 3)

    def gain(self, view: View) -> Tensor:
        """Return the brightness of a photo relative to the mean photo, by channel, shape (3,)."""
        return self._log_gains[self._place[view.name]].exp()

    def follow(self, view: View, picture: Tensor, weight: Tensor) -> None:
        """Update the gain of a photo with a new render.

        Args:
            view: The photo, or a window of it.
            picture: The render at gain 1, shape (H, W, 3).
            weight: Weight of each pixel, shape (H, W).
        """
        if not self.learned:
            return
        row = self._place[view.name]
        self._log_gains[row].lerp_(least_squares_gain(picture, view.image, weight).log(), _FOLLOWING)
        self._log_gains -= self._log_gains.mean(0)

    def even(self, view: View) -> View:
        """Return a photo scaled to the mean exposure."""
        return replace(view, image=view.image / self.gain(view)) if self.learned else view

    def expected(self, name: str) -> Tensor:
        """Return the gain (3,) to expect of a photo that took no part: in between those of its neighbours by name.

        Names follow time, and exposures too where a camera sets them by itself. Where the fitted photos' own gains are
        told no better so than by their mean, it is 1.
        """
        names = sorted({*self._place, name})
        known = [(rank, self._place[one]) for rank, one in enumerate(names) if one in self._place]
        if len(known) < _FEWEST:
            return torch.ones_like(self._log_gains[0])
        told = torch.stack([self._between(known[:k] + known[k + 1 :], rank) for k, (rank, _) in enumerate(known)])
        own = torch.stack([self._log_gains[row] for _, row in known])
        if (told - own).square().sum() >= own.square().sum():
            return torch.ones_like(own[0])
        return self._between([one for one in known if names[one[0]] != name], names.index(name)).exp()

    def _between(self, known: Sequence[tuple[int, int]], rank: int) -> Tensor:
        """Return the logarithm of the gain (3,) at a rank of names, from `known` ranks and rows, in rising order."""
        before = [one for one in known if one[0] < rank][-1:]
        after = [one for one in known if one[0] > rank][:1]
        if not before or not after:
            return self._log_gains[(before or after)[0][1]]
        (first, low), (last, high) = before[0], after[0]
        return torch.lerp(self._log_gains[low], self._log_gains[high], (rank - first) / (last - first))

    def record(self) -> dict[str, list[float]]:
        """Return the gains by photo, for fit.json."""
        gains = self._log_gains.exp().tolist()
        return {name: [round(value, 4) for value in gains[row]] for name, row in self._place.items()}

    def state(self) -> State:
        """Return the gains, for a checkpoint."""
        return {"log_gains": self._log_gains}

    def restore(self, state: State) -> None:
        """Restore what `state` returned."""
        self._log_gains = state["log_gains"]


@torch.no_grad()
def least_squares_gain(picture: Tensor, photo: Tensor, weight: Tensor) -> Tensor:
    """Return the least-squares factor (3,) of each channel from a render (H, W, 3) to a photo, weighted by pixel."""
    weighted = picture * weight[..., None]
    square = (weighted * picture).sum((0, 1))
    return torch.where(square > 0, (weighted * photo).sum((0, 1)) / square.clamp_min(1e-12), 1.0).clamp(_LEAST, _MOST)
