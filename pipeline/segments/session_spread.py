"""What scales of lengths that differ between sessions leave open of an effect that all flights have in common.

Each calibration has its own scale of lengths, which looks like a change of gravity in its session. Where sessions
differ, the mean over few of them is off, too, and an effect that does the same as another scale carries this mean: its
interval allows for it as far as flights show that sessions differ, and a session counts once, however many its flights.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..optimization.tails import student_quantile
from ..optimization.uncertainty import REACH, few_covariance, inverse
from ..physics.effects.registry import load_effect
from ..physics.parameters import Parameter, effect_parameters
from .candidates import with_added
from .segment_fit import linearised
from .segments import Segments
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.sessions
NAME = "session_scale"
"""Name of the scale of a session among the parameters."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class BesideSessions:
    """Estimates beside the scales of sessions."""

    values: Array
    """Parameters (P,) in fitted coordinates."""
    covariance: Array
    """Their covariance (P, P)."""
    spread: float
    """Standard deviation between the scales of sessions."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """The parameters (P) and the scales of n sessions, linearised at the estimates and at scales of 1."""

    information: Array
    """Information of each episode (E, P + n, P + n)."""
    score: Array
    """Score of each episode (E, P + n)."""
    count: int
    """Number of parameters P."""
    prior: Array
    """Information of the parameters' priors (P,)."""

    def solved(self, width: float) -> tuple[Array, Array]:
        """Return what the scales change of all values (P + n,), and their covariance.

        Args:
            width: Standard deviation of the prior of each scale.
        """
        sessions = self.score.shape[1] - self.count
        prior = np.diag(np.concatenate((self.prior, np.full(sessions, width**-2.0))))
        whole = self.information.sum(0) + prior
        slope = self.score.sum(0)
        slope[: self.count] = 0.0  # the parameters are where the flights want them without scales
        step = inverse(whole) @ slope
        left = self.score - self.score.mean(0) * (np.arange(len(slope)) < self.count) - self.information @ step
        return step, few_covariance(whole, left, prior)


def beside_sessions(
    flight: Segments, parameters: Sequence[Parameter], values: Tensor, sessions: Sequence[str], excess: float
) -> BesideSessions | None:
    """Return parameters fitted to flights beside the scales of sessions; None unless several have several flights.

    Args:
        flight: Flights (B) with states fitted at the estimates.
        parameters: The parameters (P).
        values: Estimates (P,) in fitted coordinates.
        sessions: Session of each flight (B); empty for none.
        excess: Factor by which variances exceed those of the noise.
    """
    names = sorted(set(sessions))
    episodes = np.array([item.episode for item in flight.items])
    own = np.array([names.index(one) for one in sessions])
    several = all(len(set(episodes[own == k])) >= LIMITS.least_episodes for k in range(len(names)))
    if len(names) < 2 or "" in names or not several:
        return None
    scale = copy.copy(load_effect("length_scale"))
    scale.name = NAME  # pyright: ignore[reportAttributeAccessIssue]
    world = with_added(flight.world, scale)
    column = next(p for p in effect_parameters(world) if p.name.partition(".")[0] == NAME)
    linear = linearised(flight.in_world(world), [*parameters, column], torch.cat((values, values.new_zeros(1))))
    joint = _joined(linear.information.numpy() / excess, linear.score.numpy() / excess, episodes, own, parameters)
    step, covariance, spread = beside(joint, column.prior[1])
    count = joint.count
    moved = values.numpy() + step[:count]
    low, high = np.array([p.limits for p in parameters]).T
    return BesideSessions(values=moved.clip(low, high), covariance=covariance[:count, :count], spread=spread)


def beside(joint: Joint, widest: float) -> tuple[Array, Array, float]:
    """Return what scales change of all values (P + n,), their covariance, and the standard deviation between scales.

    Args:
        joint: The linearised problem.
        widest: The largest standard deviation.
    """
    spread = _spread(joint, widest)
    dof = LIMITS.usual_counts + joint.score.shape[1] - joint.count - 1
    return *joint.solved(spread * student_quantile(0.975, dof) / REACH), spread


def _joined(
    information: Array,
    score: Array,
    episodes: NDArray[np.int64],
    own: NDArray[np.int64],
    parameters: Sequence[Parameter],
) -> Joint:
    """Return the problem with a scale for each session, from one with one scale for all, the last value (B, P + 1)."""
    count, sessions = len(parameters), int(own.max()) + 1
    change = np.zeros((len(own), count + sessions, count + 1))
    change[:, np.arange(count), np.arange(count)] = 1.0
    change[np.arange(len(own)), count + own, count] = 1.0
    information = change @ information @ change.swapaxes(1, 2)
    score = (change @ score[..., None])[..., 0]
    each = np.unique(episodes)
    return Joint(
        information=np.stack([information[episodes == one].sum(0) for one in each]),
        score=np.stack([score[episodes == one].sum(0) for one in each]),
        count=count,
        prior=np.array([p.prior[1] ** -2.0 for p in parameters]),
    )


def _spread(joint: Joint, width: float) -> float:
    """Return the standard deviation between the scales of sessions.

    The usual one counts for some degrees of freedom beside it: two sessions hardly tell how far sessions scatter. They
    may have one calibration as well: the variance counts by how likely the scales differ, even odds assumed before.
    """
    step, covariance = joint.solved(width)
    sessions = len(step) - joint.count
    # orthonormal contrasts between the sessions
    apart = np.linalg.qr(np.column_stack((np.ones(sessions), np.eye(sessions)[:, 1:])))[0][:, 1:].T
    scales, errors = apart @ step[joint.count :], apart @ covariance[joint.count :, joint.count :] @ apart.T
    odds = 0.5 * (_misfit(scales, errors) - _misfit(scales, errors + LIMITS.usual_scale**2 * np.eye(sessions - 1)))
    found = max(float(np.square(scales).sum()) - float(np.trace(errors)), 0.0)
    counts = LIMITS.usual_counts
    variance = (counts * LIMITS.usual_scale**2 + found) / (counts + sessions - 1)
    return min(math.sqrt(variance / (1 + math.exp(min(-odds, 700.0)))), width)


def _misfit(values: Array, covariance: Array) -> float:
    """Return minus twice the logarithm of a normal density at values (k,), but for a constant."""
    return float(values @ np.linalg.solve(covariance, values) + np.linalg.slogdet(covariance)[1])
