"""What the fits of losses in joints share, of pushes and of glides: the problem that they pose to the solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ...optimization.levenberg_marquardt import Solution, minimise
from ...physics.parameters import Parameter
from ...physics.world import World
from .force_driven import ForceDriven
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


@dataclass(frozen=True, kw_only=True)
class JointLosses:
    """Losses in joints as a least-squares problem: episodes, or parts of these (E), with T frames of J joints.

    A point has coordinates of the parameters, of what else is common to all episodes, and of the states of each.
    """

    driven: ForceDriven
    """The motion of the links under the forces that act."""
    tracks: JointTracks
    """What the tracks tell of the joints."""
    parameters: Sequence[Parameter]
    """What is fitted (P)."""
    root: Tensor
    """Symmetric root of the information of the tracks, shape (E, T, J, J)."""
    start: tuple[Tensor, Tensor, Tensor, Tensor]
    """First guess of values and speeds, and the standard deviations of their priors, each (E, J)."""
    units: Tensor
    """Units in which losses, in which the motion is linear, are coordinates; 0 for a factor, whose logarithm is one,
    shape (P,)."""
    common: ClassVar[int] = 0
    """Number of coordinates that are no parameters and common to all episodes."""

    def forces(self, values: Tensor, common: Tensor, states: Tensor, episode: Tensor) -> tuple[Tensor, Tensor]:
        """Return further generalised forces (N, T - 1, J), and what is unknown of a sensor (N, 3): none here.

        Args:
            values: Values of the parameters (N, P).
            common: Coordinates that are common to all episodes (N, C).
            states: Coordinates of the states behind those of values and speeds at the start (N, ..., J).
            episode: The episodes (N,).
        """
        return values.new_zeros(len(values), *self.tracks.values[0, 1:].shape), values.new_zeros(len(values), 3)

    def residuals(self, shared: Tensor, states: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor | None]:
        """Return residuals (E, T, J) in sigmas and their derivatives by all coordinates of a point; see `minimise`."""
        point = torch.cat((shared.expand(len(states), -1), states), 1)
        return by_differences(self._residuals, point, len(self.parameters), with_jacobian)

    def descent(
        self, states: Tensor, begin: Sequence[tuple[tuple[float, float], float, float]], damp_states: bool = True
    ) -> tuple[Solution, Tensor, Tensor]:
        """Return the robust least squares of all coordinates, and centres and information of the priors of common ones.

        Args:
            states: Of each episode to start from, with priors of unit width about 0.
            begin: Limits of each coordinate that is common, the centre of its prior, where it starts, and its width.
            damp_states: As of `minimise`.
        """
        bounds = torch.tensor([limits for limits, _, _ in begin], dtype=torch.float64)
        centre, known = torch.tensor([(middle, std**-2) for _, middle, std in begin], dtype=torch.float64).T
        point, best = centre.clone(), None
        for scale in (None, ROBUST_SCALE):  # far from the tracks a robust loss has no slope
            best = minimise(
                self.residuals,
                point,
                states,
                bounds,
                robust_scale=scale,
                iterations=ITERATIONS,
                tolerance=TOLERANCE,
                damp_states=damp_states,
                prior_information=torch.ones(states.shape[1]).to(centre),
                shared_prior=(centre, known),
            )
            point, states = best.shared, best.states
        assert best is not None
        return best, centre, known

    def _residuals(self, point: Tensor, episode: Tensor) -> Tensor:
        count, joints = len(self.parameters), self.tracks.values.shape[2]
        own, common, states = point.tensor_split((count, count + self.common), 1)
        values, states = torch.where(self.units > 0, self.units * own, own.exp()), states.unflatten(1, (-1, joints))
        middle, std = self.start[:2], self.start[2:]
        first = [middle[k][episode] + std[k][episode] * states[:, k] for k in range(2)]
        more, noted = self.forces(values, common, states[:, 2:], episode)
        column = {p.name: values[:, k] for k, p in enumerate(self.parameters)}
        moved = self.driven.motion(column, episode, first, more, noted)
        found = (self.root[episode] @ (moved - self.tracks.values[episode])[..., None])[..., 0]
        return found.nan_to_num(nan=1e6, posinf=1e6, neginf=-1e6)


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
