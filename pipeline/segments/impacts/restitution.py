"""Restitution of a ball from the heights on both sides of its bounces, by restricted maximum likelihood.

A flight follows h(t) = h0 + u t - g t^2 / 2 + k D(t) + b t^2 / 2 about its bounce, D the double integral of -|v| v_n:

- k [1/m], quadratic drag, is common to all flights. Ignored, it takes 2 to 5 % of a table-tennis ball's speed
  within the frames on both sides of an impact, and a fit takes it for restitution.
- b [m/s2] is each flight's own: lift of an unknown spin, a tilt of the frame. Its standard deviation s_b is found.
- The errors of the heights are white, and correlated in time (Ornstein-Uhlenbeck) beside.

- After an impact a soft ball still shakes: errors that decay within some hundredths of a second.

Speeds are those at the ground, whose height is found from where the flights meet: v- v+ / (v- + v+) T under it, T the
duration of contact. The restitutions v+ / v- of all impacts scatter about one. The friction of a sphere's impact in one
point does not change its normal speed, so that neither spin nor friction enters (Routh; `impact_law.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...optimization.tails import student_quantile
from ...optimization.uncertainty import REACH
from ...physics.contact_law import ContactLaw
from ...physics.world import World
from ...trajectories.observations import Observations
from ..impact_law import changes_rebound
from ..thresholds import SEGMENT_THRESHOLDS
from .bounces import Bounce, BounceSide, bounces_of, gravity_into_ground

LIMITS = SEGMENT_THRESHOLDS.bounce

Array = NDArray[np.float64]

DRAG_PRIOR = 0.3
"""Standard deviation of the prior of k [1/m]: a table-tennis ball has 0.11 to 0.15."""
LIFT_MEAN = 0.3
"""Mean of the exponential prior of s_b [m/s2]: the lift of a table-tennis ball is up to 3, that of others far less."""
NOISE_PRIOR = ((3e-4, 2.0), (3e-4, 2.0), (0.015, 0.8))
"""Medians and widths in the logarithm of the noise: white [m], slow [m], its time [s]."""
SHAKEN_MEAN, MUCH_SHAKEN = 2e-4, 5e-3
"""Mean of the exponential prior of the error after an impact [m], and that of a soft ball, as a second start."""
GROUND_STD, CONTACT_PRIOR = 0.005, (0.006, 0.006)
"""Standard deviation of the height of the ground about the given one [m]; mean and standard deviation of the duration
of a contact [s]."""
SCATTER_PRIOR = 0.02
"""Mean of the exponential prior of the scatter of the restitution from impact to impact."""
SHAKEN_S = 0.05
"""Time [s] in which what shakes a ball after an impact decays."""
MOST_FLIGHTS = 40
"""Number of flights, evenly spread, that determine the noise."""
MOST_FRAMES = 48
"""Number of frames, evenly spread, of a flight."""


@dataclass(frozen=True, kw_only=True)
class RestitutionFit:
    """Restitution of bounces (n)."""

    estimate: float
    """The restitution [1]."""
    std_error: float
    """Its standard error, widened for the number of frames that give the noise (Student)."""
    scatter: float
    """Standard deviation of the restitution from impact to impact."""
    speeds_m_s: Array
    """Normal speeds (n, 2) before and after each impact."""
    own: Array
    """Restitution of each impact, shape (n,)."""
    own_std: Array
    """Its standard error from the heights alone, shape (n,)."""
    own_covariance: Array
    """Covariance (n, n) of the restitutions about what a law gives at their speeds: heights, ground, drag, scatter."""
    drag_per_m: float
    """k [1/m], the drag that the flights need."""
    lift_m_s2: float
    """s_b [m/s2]."""
    shaken_m: float
    """Error of a height just after an impact [m]."""
    noise_m: tuple[float, float, float]
    """White noise [m], slow noise [m] and its time [s]."""

    def to_json(self) -> dict[str, Any]:
        """Return the entries for `fit.json`."""
        white_m, slow_m, slow_s = self.noise_m
        return {
            "bounces": len(self.own),
            "restitution": self.estimate,
            "std_error": self.std_error,
            "scatter": self.scatter,
            "drag_per_m": self.drag_per_m,
            "lift_std_m_s2": self.lift_m_s2,
            "shaken_m": self.shaken_m,
            "noise": {"white_m": white_m, "slow_m": slow_m, "slow_s": slow_s},
        }


@dataclass(frozen=True, kw_only=True)
class _Noise:
    """Errors of heights, and the scatter of a flight's own acceleration."""

    white_m: float
    """White noise [m]."""
    slow_m: float
    """Slow noise [m]."""
    time_s: float
    """Its correlation time [s]."""
    lift_m_s2: float
    """Scatter of the flights' own accelerations [m/s2]."""
    shaken_m: float
    """Error just after an impact [m]."""

    def covariance(self, time: Array) -> Array:
        """Return the covariance (..., n, n) of the heights at times (..., n)."""
        one, other = time[..., :, None], time[..., None, :]
        # a ball that still deforms after an impact is not where its centroid is measured
        after = time[..., :1, None] > 0
        shaken = after * self.shaken_m**2 * np.exp(-2 * np.maximum(np.maximum(one, other), 0.0) / SHAKEN_S)
        return (
            shaken
            + (self.white_m**2 + 1e-12) * np.eye(time.shape[-1])
            + self.slow_m**2 * np.exp(-np.abs(one - other) / self.time_s)
            + self.lift_m_s2**2 * (0.5 * one**2) * (0.5 * other**2)
        )


@dataclass(frozen=True, kw_only=True)
class _Flight:
    """Linear model of a flight (n frames) about the time of its bounce."""

    time: Array
    """Times, shape (n,) [s]."""
    height: Array
    """Heights without the fall g t^2 / 2, shape (n,) [m]."""
    basis: Array
    """1, t; shape (n, 2)."""
    drag: Array
    """D(t), shape (n,) [m2]."""

    @staticmethod
    def of(side: BounceSide, gravity: float) -> _Flight:
        """Return the model of one side of a bounce."""
        side = side.thinned(MOST_FRAMES)
        t = side.time_s
        fallen = side.height_m + 0.5 * gravity * t**2
        line = np.polyfit(t, fallen, 1)
        other = np.polyfit(t, side.position_m, 1)[0]
        flat2 = max(float(other @ other) - (np.polyfit(t, side.height_m, 1)[0]) ** 2, 0.0)
        # velocities along the nominal flight, from the bounce to the farthest frame
        way = np.linspace(0.0, t[np.argmax(np.abs(t))], 65)
        up = line[0] - gravity * way
        pull = -np.sqrt(up**2 + flat2) * up
        step = way[1] - way[0]
        speed = np.concatenate([[0.0], np.cumsum(0.5 * (pull[1:] + pull[:-1]))]) * step
        shift = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) * step
        order = np.argsort(way)
        drag = np.interp(t, way[order], shift[order])
        return _Flight(time=t, height=fallen, basis=np.column_stack([np.ones_like(t), t]), drag=drag)


@dataclass(frozen=True, kw_only=True)
class _Flights:
    """Flights (n) in one batch, the shorter ones padded to F frames."""

    time: Array
    """Times, 0 where there is no frame, shape (n, F) [s]."""
    known: NDArray[np.bool_]
    """Whether there is a frame, shape (n, F)."""
    columns: Array
    """1, t, D(t) and the heights, 0 where there is no frame, shape (n, F, 4)."""

    @staticmethod
    def of(flights: Sequence[_Flight]) -> _Flights:
        """Return flights as a batch."""
        most = max(len(flight.time) for flight in flights)
        time, known = np.zeros((len(flights), most)), np.zeros((len(flights), most), bool)
        columns = np.zeros((len(flights), most, 4))
        for row, flight in enumerate(flights):
            count = len(flight.time)
            time[row, :count], known[row, :count] = flight.time, True
            columns[row, :count] = np.column_stack([flight.basis, flight.drag, flight.height])
        return _Flights(time=time, known=known, columns=columns)

    def whitened(self, noise: _Noise) -> tuple[Array, Array]:
        """Return the inner products (n, 4, 4) of whitened columns, and the log determinants (n,) of the covariances."""
        both = self.known[:, :, None] & self.known[:, None]
        factor = np.linalg.cholesky(np.where(both, noise.covariance(self.time), np.eye(self.time.shape[1])))
        white = np.linalg.solve(factor, self.columns)
        return white.swapaxes(1, 2) @ white, 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(1)


@dataclass(frozen=True, kw_only=True)
class _Solved:
    """Flights (n) under a noise: states at the bounce without drag, and what drag adds."""

    states: Array
    """h0 [m] and u [m/s] for k = 0, shape (n, 2)."""
    slopes: Array
    """Their change by k, to be subtracted, shape (n, 2)."""
    covariance: Array
    """Covariance of the states for known k, shape (n, 2, 2)."""
    drag: tuple[float, float]
    """Mean and variance of k."""
    cost: float
    """-2 log of the restricted likelihood."""

    @staticmethod
    def of(flights: _Flights, noise: _Noise) -> _Solved:
        """Solve all flights for their states and the common drag."""
        product, size = flights.whitened(noise)
        normal, mixed = product[:, :2, :2], product[:, :2, 2:]
        inverse: Array = np.linalg.inv(normal).astype(np.float64)
        solved = inverse @ mixed
        # drag and heights beside the states
        left = (product[:, 2:, 2:] - mixed.swapaxes(1, 2) @ solved).sum(0)
        information, pull = 1 / DRAG_PRIOR**2 + left[0, 0], left[0, 1]
        drag = pull / information
        cost = size.sum() + np.linalg.slogdet(normal)[1].sum() + left[1, 1] + np.log(information) - drag * pull
        return _Solved(
            states=solved[:, :, 1],
            slopes=solved[:, :, 0],
            covariance=inverse,
            drag=(float(drag), float(1 / information)),
            cost=float(cost),
        )


def fit_restitution(bounces: Sequence[Bounce], gravity: float) -> RestitutionFit | None:
    """Fit one restitution to bounces; None where too few frames lie outside of the contacts.

    Args:
        bounces: Bounces of one ball.
        gravity: Into the ground [m/s2].
    """
    if not bounces:
        return None
    white, slow, time = (median for median, _ in NOISE_PRIOR)
    usual = _Noise(white_m=white, slow_m=slow, time_s=time, lift_m_s2=LIFT_MEAN, shaken_m=SHAKEN_MEAN)
    speeds = _Speeds.of(bounces, gravity, usual)
    # frames that turn out to lie within the contact belong to neither flight
    clear = [bounce.without(contact) for bounce, contact in zip(bounces, speeds.contacts, strict=True)]
    kept = [bounce for bounce in clear if bounce is not None]
    if not kept:
        return None
    flights = _flights(kept, gravity)
    noise = _found_noise(flights)
    degrees = sum(len(flight.time) for flight in flights) - 3 * len(flights)
    return _Speeds.of(kept, gravity, noise).restitution(noise, degrees)


def restitution_of(world: World, whole: Observations) -> RestitutionFit | None:
    """Return the restitution from the heights on both sides of a ball's bounces; None where these do not give it.

    Args:
        world: For the ground and the ball.
        whole: Whole episodes.
    """
    if not isinstance(world.contact, ContactLaw) or changes_rebound(world):
        return None
    bounces = bounces_of(world, whole)
    found = fit_restitution(bounces, gravity_into_ground(world)) if bounces else None
    known = found is not None and found.estimate > LIMITS.least_restitution and found.std_error < LIMITS.most_error
    return found if known else None


def _flights(bounces: Sequence[Bounce], gravity: float) -> list[_Flight]:
    """Return the flights before and after each bounce."""
    return [_Flight.of(side, gravity) for bounce in bounces for side in (bounce.before, bounce.after)]


def _found_noise(flights: Sequence[_Flight]) -> _Noise:
    """Return the noise of greatest restricted likelihood under weak priors."""
    chosen = np.unique(np.linspace(0, len(flights) - 1, MOST_FLIGHTS).round().astype(int))
    some = _Flights.of([flights[k] for k in chosen])

    def noise_at(x: Array) -> _Noise:
        white, slow, time, lift, shaken = (float(v) for v in np.exp(np.clip(x, -16.0, 3.0)))
        return _Noise(white_m=white, slow_m=slow, time_s=time, lift_m_s2=lift, shaken_m=shaken)

    def cost(x: Array) -> float:
        noise = noise_at(x)
        prior = sum(((v - np.log(m)) / w) ** 2 for v, (m, w) in zip(x, NOISE_PRIOR, strict=False))
        # exponential priors, in the logarithms
        prior += 2 * (noise.lift_m_s2 / LIFT_MEAN - x[3] + noise.shaken_m / SHAKEN_MEAN - x[4])
        return _Solved.of(some, noise).cost + prior

    from scipy.optimize import minimize

    ends = []
    for shaken in (SHAKEN_MEAN, MUCH_SHAKEN):  # the likelihood may have a maximum with and one without
        start = np.log([*(m for m, _ in NOISE_PRIOR), LIFT_MEAN, shaken])
        simplex = np.vstack([start, *(start + 0.7 * axis for axis in np.eye(len(start)))])
        options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.1, "maxfev": 200}
        ends.append(minimize(cost, start, method="Nelder-Mead", options=options))
    return noise_at(min(ends, key=lambda end: end.fun).x)


@dataclass(frozen=True, kw_only=True)
class _Speeds:
    """Normal speeds of impacts (n) at the ground."""

    speeds: Array
    """Before and after, shape (n, 2) [m/s], both positive."""
    covariance: Array
    """Covariance of all of them, drag and ground included, shape (2 n, 2 n)."""
    contacts: list[tuple[float, float]]
    """Start and end of each contact from the frame of least height [s]."""
    drag: float
    """k [1/m]."""

    @staticmethod
    def of(bounces: Sequence[Bounce], gravity: float, noise: _Noise) -> _Speeds:
        """Return the speeds of bounces under a noise."""
        solved = _Solved.of(_Flights.of(_flights(bounces, gravity)), noise)
        drag, variance = solved.drag
        states = (solved.states - drag * solved.slopes).reshape(-1, 2, 2)
        ground, contact_s, ground_var = _ground(states, solved.covariance.reshape(-1, 2, 2, 2))
        over = states[..., 0] - ground
        sign = np.array([-1.0, 1.0])
        speed = np.sqrt(np.clip(states[..., 1] ** 2 + 2 * gravity * over, 1e-6, None))
        # v = sqrt(u^2 + 2 g (h0 - ground))
        by_state = np.stack([gravity / speed, states[..., 1] / speed], -1).reshape(-1, 2)
        by_drag = -(by_state * solved.slopes).sum(-1)
        by_ground = -gravity / speed.ravel()
        cover = np.diag(np.einsum("ni,nij,nj->n", by_state, solved.covariance, by_state))
        cover += variance * np.outer(by_drag, by_drag) + ground_var * np.outer(by_ground, by_ground)
        reached = (states[..., 1] - sign * speed) / gravity  # times at which the flights are on the ground
        lead = LIMITS.apart_s
        contacts = [(a - lead, max(b, a + contact_s) + lead) for a, b in reached]
        return _Speeds(speeds=speed, covariance=cover, contacts=contacts, drag=drag)

    def restitution(self, noise: _Noise, degrees: int) -> RestitutionFit:
        """Return the restitution of all impacts, each with its own scatter about it.

        Args:
            noise: That of the heights.
            degrees: Degrees of freedom that it was found with.
        """
        from scipy.linalg import cho_factor, cho_solve  # dear to import, and seldom needed

        fall, rise = self.speeds.T
        count = len(fall)
        own = rise / fall
        slope = np.zeros((count, 2 * count))
        rows = np.arange(count)
        slope[rows, 2 * rows], slope[rows, 2 * rows + 1] = -own / fall, 1 / fall
        cover = slope @ self.covariance @ slope.T
        ones = np.ones(count)

        def solved(scatter: float) -> tuple[float, float, float]:
            factor = cho_factor(cover + (scatter**2 + 1e-12) * np.eye(count), lower=True)
            weight = cho_solve(factor, ones)
            mean = float(weight @ own / weight.sum())
            cost = 2 * np.log(np.diag(factor[0])).sum() + np.log(weight.sum())
            cost += (own - mean) @ cho_solve(factor, own - mean) + 2 * scatter / SCATTER_PRIOR
            return float(cost), mean, float(1 / weight.sum())

        # few impacts do not tell their scatter: the mean over what it may be
        grid = np.concatenate([[0.0], np.geomspace(1e-3, 0.3, 30)])
        costs, means, variances = np.array([solved(float(s)) for s in grid]).T
        weight = np.exp(-0.5 * (costs - costs.min())) * np.gradient(grid)
        weight /= weight.sum()
        scatter, mean = float(weight @ grid), float(weight @ means)
        variance = float(weight @ (variances + (means - mean) ** 2))
        wider = float(student_quantile(0.975, max(degrees, 2))) / REACH
        return RestitutionFit(
            estimate=mean,
            std_error=wider * float(np.sqrt(variance)),
            scatter=scatter,
            speeds_m_s=self.speeds,
            own=own,
            own_std=np.sqrt(np.diag(cover)),
            own_covariance=wider**2 * (cover + (scatter**2 + 1e-12) * np.eye(count)),
            drag_per_m=self.drag,
            lift_m_s2=noise.lift_m_s2,
            shaken_m=noise.shaken_m,
            noise_m=(noise.white_m, noise.slow_m, noise.time_s),
        )


def _ground(states: Array, covariance: Array) -> tuple[float, float, float]:
    """Return height of the ground [m], duration of contact [s] and the variance of the height.

    Two flights, of the same curvature, with h0 and u about the same time meet v- v+ / (v- + v+) T under the ground.

    Args:
        states: h0 [m] and u [m/s] before and after, shape (n, 2, 2).
        covariance: Of the states, shape (n, 2, 2, 2).
    """
    apart = states[:, 0] - states[:, 1]
    meet = -apart[:, 0] / apart[:, 1]
    height = states[:, 0, 0] + states[:, 0, 1] * meet
    # weights of the two flights in the height at which their lines cross
    share = np.stack([-states[:, 1, 1], states[:, 0, 1]], -1) / apart[:, 1:]
    across = np.stack([np.ones_like(share), np.broadcast_to(meet[:, None], share.shape)], -1)
    variance = ((share**2) * np.einsum("nsi,nsij,nsj->ns", across, covariance, across)).sum(-1)
    fall, rise = -states[:, 0, 1], states[:, 1, 1]
    rows = np.column_stack([np.ones_like(fall), -fall * rise / (fall + rise)])
    weight = 1 / (variance + 1e-8)
    prior = np.diag([1 / GROUND_STD**2, 1 / CONTACT_PRIOR[1] ** 2])
    normal = rows.T @ (weight[:, None] * rows) + prior
    inverse = np.linalg.inv(normal)
    found = inverse @ (rows.T @ (weight * height) + prior @ np.array([0.0, CONTACT_PRIOR[0]]))
    if found[1] < 0:  # no contact ends before it begins
        found = np.array([(weight @ height) / (weight.sum() + prior[0, 0]), 0.0])
    return float(found[0]), float(found[1]), float(inverse[0, 0])
