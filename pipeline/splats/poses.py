"""Small errors of the photos' camera poses, found by a fit of spheres that carries motions of the cameras along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .exposures import Exposures, least_squares_gain
from .fit import Rates, Trainable, descend
from .losses import photometric, scene_weight
from .spheres import Spheres
from .views import View, render_view

_RATE = 1e-3
_SPREAD = 0.02
"""Standard deviation that the prior gives an angle [rad], or a movement of a camera in units of the cameras' spread."""
_PRIOR = 1e-4
_SINGLE_STEPS = 60


def learn_motions(
    views: Sequence[View], start: Spheres, exposures: Exposures, spread: float, iterations: int, seed: int
) -> dict[str, Tensor]:
    """Fit spheres to photos together with small motions of the cameras; return new camera frame from old one, (4, 4).

    The spheres are thrown away. The cameras as a whole stand where they stood: photos alone do not tell.

    Args:
        views: The photos; pixels of bodies are left out where masks show them.
        start: Spheres of the background.
        exposures: Gains of the photos, learned along.
        spread: Size of the cameras' arrangement [m], the unit of their movements.
        iterations: Steps.
        seed: Seed.
    """
    twists = {view.name: view.image.new_zeros(6, requires_grad=True) for view in views}

    def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        twist, weight = twists[view.name], scene_weight(view)
        picture = render_view(spheres, moved(view, _motion(twist, spread))).features[0]
        exposures.follow(view, picture.detach(), weight)
        picture = exposures.gain(view) * picture
        return _loss(picture, view, weight, twist), (picture - view.image).detach().square().mean()

    trainable = Trainable(start, Rates(means=0.02, log_scales=0.01, logits=0.03, colors=0.015))
    beside = [{"params": list(twists.values()), "lr": _RATE}]
    descend(trainable, views, loss, iterations, seed, "camera poses", 0.001, beside)
    with torch.no_grad():
        return _anchored(views, {view.name: _motion(twists[view.name], spread) for view in views})


def find_motion(spheres: Spheres, view: View, weight: Tensor, spread: float) -> Tensor:
    """Return new camera frame from old one (4, 4) of a photo against spheres that stay as they are.

    Args:
        spheres: The spheres, world frame.
        view: The photo.
        weight: How much each pixel counts, shape (H, W).
        spread: Size of the cameras' arrangement [m].
    """
    twist = view.image.new_zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([twist], _RATE)
    for _ in range(_SINGLE_STEPS):
        picture = render_view(spheres, moved(view, _motion(twist, spread))).features[0]
        picture = picture * least_squares_gain(picture.detach(), view.image, weight)
        optimiser.zero_grad()
        _loss(picture, view, weight, twist).backward()
        optimiser.step()
    return _motion(twist.detach(), spread)


def moved(view: View, T_new_old: Tensor) -> View:
    """Return a photo whose camera stands elsewhere; for the renderer alone, its `camera` stays."""
    return replace(view, viewmat=T_new_old @ view.viewmat)


def moved_for_good(view: View, T_new_old: Tensor) -> View:
    """Return a photo whose camera stands elsewhere."""
    viewmat = T_new_old @ view.viewmat
    camera = replace(view.camera, T_world_cam=np.linalg.inv(viewmat.double().cpu().numpy()))
    return replace(view, viewmat=viewmat, camera=camera)


def motion_record(motions: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return how far the cameras moved, as plain numbers for fit.json."""
    moves = {name: T.double().cpu().numpy() for name, T in motions.items()}
    return {
        "moved_m": {name: round(float(np.linalg.norm(T[:3, 3])), 6) for name, T in moves.items()},
        "turned_deg": {name: round(_angle_deg(T), 4) for name, T in moves.items()},
    }


def _loss(picture: Tensor, view: View, weight: Tensor, twist: Tensor) -> Tensor:
    return photometric(picture, view.image, weight) + _PRIOR * (twist / _SPREAD).square().sum()


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
