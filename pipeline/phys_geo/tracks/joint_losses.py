"""What the fits of losses in joints share, of pushes and of glides: the problem that they pose to the solver."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ...physics.world import World
from .joint_tracks import JointTracks

MOST_FRAMES = 400
"""Maximum number of frames of an episode, counted from shortly before the first force."""
START = 10.0
"""Standard deviation of the prior of a start, in errors of the first frames."""
FIRST_FRAMES = 5
"""Frames of the straight line that is the first guess of a start."""
STEPS = (0.03, 0.05)
"""Steps of the differences: of a parameter, and of the other coordinates in their standard deviations."""
ROBUST_SCALE = 4.0
"""Scale of the robust loss of a frame, in standard deviations."""
ITERATIONS, TOLERANCE = 80, 1e-5
"""Limit on steps of a descent, and the share of the cost below which a step ends it."""
FLAT = 0.1
"""Information of the prior of a loss in a descent, in its unit, as a root: draws have the real one."""


def takes(world: World) -> bool:
    """Return whether a world is one passive jointed body on a fixed root, beside driven and fixed ones."""
    one = len(world.chains) == 1 and world.chains[0].base == "fixed" and not world.chains[0].touching
    one = one and not world.chains[0].has_servos
    links = set(world.chains[0].links) if one else set()
    return one and not world.effects and all(world.bodies[k].name in links for k in world.tracked)


def starts(tracks: JointTracks) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return first guesses of values and speeds, and the standard deviations of their priors, each (E, J)."""
    t = (tracks.times_s - tracks.times_s[:, :1])[:, :FIRST_FRAMES, None]
    first = tracks.values[:, :FIRST_FRAMES]
    middle, mean = t.mean(1, keepdim=True), first.mean(1, keepdim=True)
    spread = (t - middle).square().sum(1)
    speed = ((t - middle) * (first - mean)).sum(1) / spread
    known = tracks.information[:, :FIRST_FRAMES].diagonal(dim1=-2, dim2=-1).amax(1)
    error = START * known.clamp_min(1e-12).rsqrt()
    return mean[:, 0] - speed * middle[:, 0], speed, error, error / spread.sqrt()


def information_root(information: Tensor) -> Tensor:
    """Return the symmetric roots of informations (..., J, J)."""
    values, axes = torch.linalg.eigh(information)
    return (axes * values.clamp_min(0.0).sqrt()[..., None, :]) @ axes.transpose(-1, -2)


def by_differences(
    residuals: Callable[[Tensor, Tensor], Tensor], point: Tensor, count: int, with_jacobian: bool
) -> tuple[Tensor, Tensor | None]:
    """Return residuals (E, T, J) and their derivatives (E, T, J, V) by central differences over `STEPS`, or None.

    Args:
        residuals: Returns residuals (N, T, J) at values (N, V) of the episodes or parts (N,).
        point: The values (E, V).
        count: Number of them that are parameters, those first; the others are of states.
        with_jacobian: Whether the derivatives are wanted.
    """
    every = torch.arange(len(point))
    if not with_jacobian:
        return residuals(point, every), None
    steps = torch.tensor([STEPS[0]] * count + [STEPS[1]] * (point.shape[1] - count)).to(point)
    moves = torch.cat((0 * steps[None], torch.diag(steps), -torch.diag(steps)))
    moved = (point[None] + moves[:, None]).flatten(0, 1)
    found = residuals(moved, every.repeat(len(moves))).unflatten(0, (len(moves), -1))
    ahead, behind = found[1:].chunk(2)
    return found[0], ((ahead - behind) / (2 * steps[:, None, None, None])).movedim(0, -1)
