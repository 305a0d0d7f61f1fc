"""Corrections of the photos' camera poses, learned together with a fit of spheres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...geometry.spheres import Spheres
from ...optimization.adam import Adam
from ...rendering.image_metrics import photometric
from ...runtime.checkpoint import State
from .photo_exposure import least_squares_gain
from .views import View, render_view

RATE, LAST_RATE = 1e-3, 1e-4
"""Step size of Adam at the start and at the end: angles in rad, translations in units of the cameras' spread."""
WAITING = 0.1
"""Share of a fit during which the cameras stay fixed, because the spheres do not show the scene yet."""
_SPREAD = 0.02
"""Standard deviation of the prior: of an angle [rad], and of a translation in units of the cameras' spread."""
_PRIOR = 1e-4
_SINGLE_RATE, _SINGLE_STEPS = 1e-3, 60


class Motions:
    """A small rigid motion of the camera of each photo, learned while spheres are fitted.

    Args:
        views: The photos.
        spread: Size of the cameras' arrangement [m], the unit of their translations.
    """

    def __init__(self, views: Sequence[View], spread: float) -> None:
        self._spread = spread
        self._twists = {view.name: view.image.new_zeros(6, requires_grad=True) for view in views}
        self._adam = Adam([{"params": list(self._twists.values()), "lr": RATE}])

    def moved(self, view: View) -> View:
        """Return a photo with the current pose of its camera, differentiable; the field `camera` stays."""
        return moved(view, _motion(self._twists[view.name], self._spread))

    def prior(self, view: View) -> Tensor:
        """Return the prior penalty of the motion of a photo's camera, shape ()."""
        return _prior(self._twists[view.name])

    def step(self, share: float) -> None:
        """Move the cameras whose photos were rendered, when `share` of the fit is over."""
        self._adam.param_groups[0]["lr"] = 0.0 if share < WAITING else RATE * (LAST_RATE / RATE) ** share
        self._adam.step()
        self._adam.zero_grad()

    @torch.no_grad()
    def found(self, views: Sequence[View]) -> dict[str, Tensor]:
        """Return the transform from the old to the new camera frame (4, 4) of each photo, without their common motion.

        Photos alone cannot distinguish a motion of all cameras from one of the world.
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
        """Restore what `state` returned."""
        for name, twist in self._twists.items():
            twist.copy_(state["twists"][name])
        self._adam.load_state_dict(state["adam"])


def find_motion(spheres: Spheres, view: View, weight: Tensor, spread: float) -> Tensor:
    """Fit the transform from the old to the new camera frame (4, 4) of a photo to fixed spheres.

    Args:
        spheres: The spheres, world frame.
        view: The photo.
        weight: Weight of each pixel, shape (H, W).
        spread: Size of the cameras' arrangement [m].
    """
    twist = view.image.new_zeros(6, requires_grad=True)
    optimiser = Adam([{"params": [twist], "lr": _SINGLE_RATE}])
    for _ in range(_SINGLE_STEPS):
        picture = render_view(spheres, moved(view, _motion(twist, spread))).features[0]
        picture = picture * least_squares_gain(picture.detach(), view.image, weight)
        optimiser.zero_grad()
        (photometric(picture, view.completed(picture.detach()), weight) + _prior(twist)).backward()
        optimiser.step()
        optimiser.decay((LAST_RATE / _SINGLE_RATE) ** (1 / _SINGLE_STEPS))
    return _motion(twist.detach(), spread)


def moved(view: View, T_new_old: Tensor) -> View:
    """Return a photo with a moved camera for the renderer alone; the field `camera` stays."""
    return replace(view, viewmat=T_new_old @ view.viewmat)


def moved_for_good(view: View, T_new_old: Tensor) -> View:
    """Return a photo with a moved camera, including the field `camera`."""
    there = moved(view, T_new_old)
    T_world_cam = np.linalg.inv(there.viewmat.double().cpu().numpy())
    return replace(there, camera=replace(view.camera, T_world_cam=T_world_cam))


def motion_record(motions: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the sizes of the camera motions, as plain numbers for fit.json."""
    moves = {name: T.double().cpu().numpy() for name, T in motions.items()}
    return {
        "moved_m": {name: round(float(np.linalg.norm(T[:3, 3])), 6) for name, T in moves.items()},
        "turned_deg": {name: round(_angle_deg(T), 4) for name, T in moves.items()},
    }


def _prior(twist: Tensor) -> Tensor:
    return _PRIOR * (twist / _SPREAD).square().sum()


def _motion(twist: Tensor, spread: float) -> Tensor:
    """Return the exponential (4, 4) of a twist (6,): angles [rad], then translation in units of the spread [m]."""
    x, y, z = twist[:3]
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rows = torch.cat([turn, spread * twist[3:, None]], 1)
    return torch.linalg.matrix_exp(torch.cat([rows, torch.zeros_like(rows[:1])]))


def _anchored(views: Sequence[View], motions: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove the common motion of all cameras: mean rotation, and scale and translation of their centres."""
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
