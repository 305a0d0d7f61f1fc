"""What differs from photo to photo besides the scene: exposure, white balance, and small errors of the camera's pose.

A first fit of spheres carries them along, a gain of each colour channel and a small motion of the camera for every
photo; then the photos are divided by their gains, the cameras moved, and the fit proper sees photos that agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .fit import Rates, Trainable, descend
from .losses import photometric, scene_weight
from .spheres import Spheres
from .views import View, render_view

_GAIN_RATE, _POSE_RATE = 0.01, 1e-3
_GAIN_SPREAD, _POSE_SPREAD = 0.3, 0.02
"""Standard deviations that the prior gives a logarithm of a gain, and an angle [rad] or a movement of a camera in units
of the cameras' spread."""
_PRIOR = 1e-4
_EQUAL = 0.02
_SINGLE_STEPS = 60


@dataclass(frozen=True)
class Corrections:
    """What was found, by photo.

    Attributes:
        gains: Brightness of the photo relative to the mean photo, by channel, (3,).
        motions: New camera frame from old one, (4, 4); empty where poses stay as they are.
    """

    gains: dict[str, Tensor]
    motions: dict[str, Tensor]

    def corrected(self, view: View) -> View:
        """Return a photo in the mean exposure, from where its camera was found to be."""
        image = view.image
        if view.name in self.gains:
            image = image / self.gains[view.name]
        if view.name not in self.motions:
            return replace(view, image=image)
        viewmat = self.motions[view.name] @ view.viewmat
        T_world_cam = np.linalg.inv(viewmat.double().cpu().numpy())
        return replace(view, image=image, viewmat=viewmat, camera=replace(view.camera, T_world_cam=T_world_cam))

    def record(self) -> dict[str, Any]:
        """Return the corrections as plain numbers, for fit.json."""
        moved = {name: T.double().cpu().numpy() for name, T in self.motions.items()}
        return {
            "gain_rgb": {name: [round(value, 4) for value in gain.tolist()] for name, gain in self.gains.items()},
            "camera_moved_m": {name: round(float(np.linalg.norm(T[:3, 3])), 6) for name, T in moved.items()},
            "camera_turned_deg": {name: round(_angle_deg(T), 4) for name, T in moved.items()},
        }


class _Moving:
    """Gains and motions while they are being learned."""

    def __init__(self, views: Sequence[View], spread: float, exposure: bool, poses: bool) -> None:
        zero = views[0].image
        self.log_gains = {view.name: zero.new_zeros(3, requires_grad=exposure) for view in views}
        self.twists = {view.name: zero.new_zeros(6, requires_grad=poses) for view in views}
        self.spread, self.exposure, self.poses = spread, exposure, poses

    def groups(self) -> list[dict[str, Any]]:
        rates = ((self.log_gains, _GAIN_RATE, self.exposure), (self.twists, _POSE_RATE, self.poses))
        return [{"params": list(values.values()), "lr": rate} for values, rate, moving in rates if moving]

    def motion(self, view: View) -> Tensor:
        return _motion(self.twists[view.name], self.spread)

    def loss(self, spheres: Spheres, view: View, weight: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the photometric loss with the corrections applied and their prior, and the mean square error."""
        log_gain, twist = self.log_gains[view.name], self.twists[view.name]
        moved = replace(view, viewmat=self.motion(view) @ view.viewmat) if self.poses else view
        picture = render_view(spheres, moved).features[0] * log_gain.exp()
        prior = (log_gain / _GAIN_SPREAD).square().sum() + (twist / _POSE_SPREAD).square().sum()
        value = photometric(picture, view.image, weight) + _PRIOR * prior
        return value, (picture - view.image).detach().square().mean()


def learn_corrections(
    views: Sequence[View], start: Spheres, spread: float, iterations: int, seed: int, *, exposure: bool, poses: bool
) -> Corrections:
    """Fit spheres to photos together with the photos' corrections; the spheres are thrown away.

    What photos alone do not tell stays: gains are 1 in their geometric mean, and the cameras as a whole stand where
    they stood.

    Args:
        views: The photos; pixels of bodies are left out where masks show them.
        start: Spheres of the background.
        spread: Size of the cameras' arrangement [m], the unit of their movements.
        iterations: Steps.
        seed: Seed.
        exposure: Whether to learn gains.
        poses: Whether to learn motions of the cameras.
    """
    moving = _Moving(views, spread, exposure, poses)

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        return moving.loss(spheres, view, scene_weight(view))

    trainable = Trainable(start, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
    descend(trainable, views, loss, iterations, seed, "photos: exposure and poses", 0.001, moving.groups())
    with torch.no_grad():
        gains = _centred(moving.log_gains) if exposure else {}
        motions = {view.name: moving.motion(view) for view in views} if poses else {}
        return Corrections(gains, _anchored(views, motions) if poses else {})


def correct_one(spheres: Spheres, view: View, spread: float, *, exposure: bool, poses: bool) -> Corrections:
    """Find the corrections of one photo against spheres that stay as they are; for photos that the fit did not see.

    Only the left half of the picture is looked at, so that the right half remains for a fair comparison.
    """
    moving = _Moving([view], spread, exposure, poses)
    weight = torch.zeros_like(view.image[..., 0])
    weight[:, : weight.shape[1] // 2] = 1.0
    optimiser = torch.optim.Adam(moving.groups())
    for _ in range(_SINGLE_STEPS):
        value, _ = moving.loss(spheres, view, weight)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
    with torch.no_grad():
        gains = {view.name: moving.log_gains[view.name].exp()} if exposure else {}
        return Corrections(gains, {view.name: moving.motion(view)} if poses else {})


def _motion(twist: Tensor, spread: float) -> Tensor:
    """Return exp of a twist: angles [rad] and movement in units of the spread [m], (6,), as a transform (4, 4)."""
    x, y, z = twist[:3]
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    rows = torch.cat([turn, spread * twist[3:, None]], 1)
    return torch.linalg.matrix_exp(torch.cat([rows, torch.zeros_like(rows[:1])]))


def _centred(log_gains: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return gains whose geometric mean is 1; none where all are equal within what such a fit can tell."""
    mean = torch.stack(list(log_gains.values())).mean(0)
    centred = {name: value - mean for name, value in log_gains.items()}
    if max(float(value.abs().max()) for value in centred.values()) < _EQUAL:
        return {}
    return {name: value.exp() for name, value in centred.items()}


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
