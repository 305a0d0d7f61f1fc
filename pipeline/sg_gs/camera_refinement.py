"""Small errors of the photos' camera poses, found by a fit of spheres that carries motions of the cameras along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checkpoint import State
from .exposures import least_squares_gain
from .losses import photometric
from .spheres import Spheres
from .views import View, render_view

RATE, LAST_RATE = 1e-3, 1e-4
"""Adam's step size at the beginning and at the end; of angles [rad], of movements in units of the cameras' spread."""
WAITING = 0.1
"""Share of a fit during which the cameras stay, for there is nothing yet to stand right before."""
_SPREAD = 0.02
"""Standard deviation that the prior gives an angle [rad], or a movement in units of the cameras' spread."""
_PRIOR = 1e-4
_SINGLE_RATE, _SINGLE_STEPS = 1e-3, 60


class Motions:
    """A small motion of the camera for each photo, learned while spheres are fitted.

    Args:
        views: The photos.
        spread: Size of the cameras' arrangement [m], the unit of their movements.
    """

    def __init__(self, views: Sequence[View], spread: float) -> None:
        self._spread = spread
        self._twists = {view.name: view.image.new_zeros(6, requires_grad=True) for view in views}
        self._adam = torch.optim.Adam(list(self._twists.values()), RATE)

    def moved(self, view: View) -> View:
        """Return a photo as its camera stands now, connected to what is learned; its `camera` stays."""
        return moved(view, _motion(self._twists[view.name], self._spread))

    def prior(self, view: View) -> Tensor:
        """Return the penalty of a photo's motion, ()."""
        return _prior(self._twists[view.name])

    def step(self, share: float) -> None:
        """Move the cameras whose photos were looked at; `share` of the fit is over."""
        self._adam.param_groups[0]["lr"] = 0.0 if share < WAITING else RATE * (LAST_RATE / RATE) ** share
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    @torch.no_grad()
    def found(self, views: Sequence[View]) -> dict[str, Tensor]:
        """Return new camera frame from old one (4, 4) by photo; the cameras as a whole stand where they stood.

        Photos alone do not tell a motion of all cameras from one of the world.
        """
        return _anchored(views, {view.name: _motion(self._twists[view.name], self._spread) for view in views})

    def state(self) -> State:
        """Return the motions, for a checkpoint."""
        return {
            "twists": {name: twist.detach() for name, twist in self._twists.items()},
            "adam": self._adam.state_dict(),
        }

    @torch.no_grad()
    def restore(self, state: State) -> None:
        """Take up what `state` returned."""
        for name, twist in self._twists.items():
            twist.copy_(state["twists"][name])
        self._adam.load_state_dict(state["adam"])


def find_motion(spheres: Spheres, view: View, weight: Tensor, spread: float) -> Tensor:
    """Return new camera frame from old one (4, 4) of a photo against spheres that stay as they are.

    Args:
        spheres: The spheres, world frame.
        view: The photo.
        weight: How much each pixel counts, shape (H, W).
        spread: Size of the cameras' arrangement [m].
    """
    twist = view.image.new_zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([twist], _SINGLE_RATE)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimiser, (LAST_RATE / _SINGLE_RATE) ** (1 / _SINGLE_STEPS))
    for _ in range(_SINGLE_STEPS):
        picture = render_view(spheres, moved(view, _motion(twist, spread))).features[0]
        picture = picture * least_squares_gain(picture.detach(), view.image, weight)
        optimiser.zero_grad()
        (photometric(picture, view.image, weight) + _prior(twist)).backward()
        optimiser.step()
        decay.step()
    return _motion(twist.detach(), spread)


def moved(view: View, T_new_old: Tensor) -> View:
    """Return a photo whose camera stands elsewhere; for the renderer alone, its `camera` stays."""
    return replace(view, viewmat=T_new_old @ view.viewmat)


def moved_for_good(view: View, T_new_old: Tensor) -> View:
    """Return a photo whose camera stands elsewhere."""
    there = moved(view, T_new_old)
    T_world_cam = np.linalg.inv(there.viewmat.double().cpu().numpy())
    return replace(there, camera=replace(view.camera, T_world_cam=T_world_cam))


def motion_record(motions: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return how far the cameras moved, as plain numbers for fit.json."""
    moves = {name: T.double().cpu().numpy() for name, T in motions.items()}
    return {
        "moved_m": {name: round(float(np.linalg.norm(T[:3, 3])), 6) for name, T in moves.items()},
        "turned_deg": {name: round(_angle_deg(T), 4) for name, T in moves.items()},
    }


def _prior(twist: Tensor) -> Tensor:
    return _PRIOR * (twist / _SPREAD).square().sum()


def _motion(twist: Tensor, spread: float) -> Tensor:
    """Return exp of a twist: angles [rad] and movement in units of the spread [m], (6,), as a transform (4, 4)."""
    x, y, z = twist[:3]
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rows = torch.cat([turn, spread * twist[3:, None]], 1)
    return torch.linalg.matrix_exp(torch.cat([rows, torch.zeros_like(rows[:1])]))


def _anchored(views: Sequence[View], motions: dict[str, Tensor]) -> dict[str, Tensor]:
    """Take off what moves all cameras alike: their mean turn, and scale and shift of their centres."""
    old = np.stack([np.linalg.inv(view.viewmat.double().cpu().numpy()) for view in views])
    moves = np.stack([motions[view.name].double().cpu().numpy() for view in views])
    new = old @ np.linalg.inv(moves)
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", old[:, :3, :3], new[:, :3, :3]))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    a, b = ((T[:, :3, 3] - T[:, :3, 3].mean(0)) for T in (new, old))
    a = a @ turn.T
    scale = (a * b).sum() / max((a * a).sum(), 1e-12)
    new[:, :3, :3] = turn @ new[:, :3, :3]
    new[:, :3, 3] = scale * a + old[:, :3, 3].mean(0)
    return {
        view.name: torch.as_tensor(np.linalg.inv(here) @ there).to(view.viewmat)
        for view, here, there in zip(views, new, old, strict=True)
    }


def _angle_deg(T: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))))
