"""Correlated measurement noise: its strength and correlation time, from short windows of flight.

A tracker that filters, a marker that moves over a ball or a calibration with local errors makes errors that
neighbouring frames share. Forces are identified by slow changes, and correlated errors are slow. The noise is an
process of Matern's class plus white noise: with a share s of the variance whose correlation is k(dt), the covariance of
two frames is s k(dt), plus 1 - s on the diagonal (see `innovations`). The order of the process matters: of errors that
a filter has smoothed, one that is not differentiable makes the slow part a hundred times too large. Errors slower than
a window do not show here; they are looked for in whole flights (`segments/flights/slow_errors`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.rotation import quat_turn
from ..optimization.levenberg_marquardt import Solution
from .innovations import MOST_NUMBERS, RESOLUTION_S, WHITE, CorrelatedNoise, NoiseModel, matern, with_white
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS
from .track_noise import FLOOR_M, FLOOR_RAD, Noise

Array = NDArray[np.float64]
LIMITS = TRACK_THRESHOLDS.track_noise

LONGEST_S = 0.4
"""Maximum length [s] of a window. A longer one shows more of the correlation, but a force that changes within it may be
taken for noise."""
LEAST_DEGREE, MOST_DEGREE = 4, 12
"""Minimum and maximum degree of the polynomials."""
CIRCLE_LEFT = 1e-3
"""Largest residual of the circle of a point about the centre of mass, as a share of its radius, that sets the
degree."""
LARGEST_TURN = 2.5
"""Maximum rotation [rad] within a window of rotations: rotation vectors of a tumbling body are polynomials only near
zero."""
LEAST = 4
"""Minimum number of frames of a window in excess of the coefficients of its polynomial."""
REMEMBERED = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Correlations from one frame to the next of a process of order 1/2, whose times are tried for all orders."""
SHARES = {0.5: (1.0, 0.75, 0.5, 0.25), 1.5: (0.99, 0.9, 0.75, 0.5, 0.25), 2.5: (0.999, 0.99, 0.9, 0.75, 0.5)}
"""Shares of the variance that is correlated, that are tried, by order: what is smooth alone could not be inverted."""
FAR = 200
"""Number of frames over which correlations are summed for the size of the slow part."""
FLOORS = (FLOOR_M, FLOOR_RAD)
"""Smallest standard deviations of position [m] and rotation [rad] at which correlation is looked for."""
ROBUST_SCALE = 3.0
"""Scale of the robust loss with which windows are fitted, in sigmas."""
MOST_CORRELATED = 0.98
"""Maximum correlation from frame to frame."""


def estimate_noise_model(
    whole: Observations, flight: Sequence[Segment], tracks: Noise
) -> tuple[NoiseModel, tuple[float | None, float | None]]:
    """Estimate how the tracks' errors in flight are correlated, without any motion model, and how large they are.

    The evidence of positions and rotations is added, because a filter correlates both.

    Args:
        whole: The episodes (E).
        flight: Their flight segments.
        tracks: A first guess of the standard deviations, beside errors of the frames' times.

    Returns:
        The noise model; standard deviations of position [m] and rotation [rad], None for uncorrelated ones.
    """
    found = [_likeliest(whole, flight, kind, tracks[kind]) for kind in (0, 1)]
    if whole.time_shift is not None:  # how much times add to the errors is known in units of the latter
        found = [_likeliest(whole, flight, k, one.std or tracks[k]) for k, one in enumerate(found)]
    if sum(one.evidence for one in found) < LIMITS.sure_both:
        return WHITE, (None, None)
    # rounding errors of exact values are correlated from frame to frame, too
    sure = [one.evidence > LIMITS.sure_alone and one.std > floor for one, floor in zip(found, FLOORS, strict=True)]
    if not any(sure):
        return WHITE, (None, None)
    noise = NoiseModel(*(one.noise if yes else CorrelatedNoise() for one, yes in zip(found, sure, strict=True)))
    position, rotation = (one.std if yes else None for one, yes in zip(found, sure, strict=True))
    return noise, (position, rotation)


def noise_model_warnings(memory: NoiseModel) -> str:
    """Return a warning that says how long errors are correlated, and what follows."""
    times = [
        f"{name}: {1e3 * noise.time_s:.0f} ms"
        for name, noise in zip(("position", "rotation"), memory, strict=True)
        if noise.share
    ]
    return (
        f"the tracking errors are correlated in time ({', '.join(times)}), as after smoothing. This is modelled, which "
        "makes slow forces harder to detect. Use unsmoothed tracks if you have them."
    )


def _likeliest(whole: Observations, flight: Sequence[Segment], kind: int, std: float) -> _Found:
    """Return the likeliest noise model of positions (kind 0) or rotations (1).

    Restricted maximum likelihood (Patterson & Thompson 1971): of the residuals of a polynomial in every window.
    Variances that errors of times add are in units of a standard deviation `std` of the tracks.
    """
    windows = _windows(whole, flight, kind, std)
    if sum(w.count for w in windows) < LIMITS.enough:
        return _Found(CorrelatedNoise(), 0.0, 0.0)
    sizes = np.concatenate([w.variances for w in windows])
    kept = [w.without(LIMITS.wrong * float(np.median(sizes))) for w in windows]
    windows = [w for w in kept if len(w.left)]
    step = float(np.median([np.median(np.diff(w.times_s, axis=1)) for w in windows]))
    span_s = float(np.median(np.concatenate([w.times_s[:, -1] - w.times_s[:, 0] for w in windows])))
    windows = [w.merged() for w in windows]
    ((alone, white_std),) = _likelihoods(windows, [CorrelatedNoise()])
    if white_std == 0:  # values that never change, or repeat a polynomial to the last bit: there are no errors to see
        return _Found(CorrelatedNoise(), 0.0, 0.0)
    gaps = step * torch.arange(1, FAR, dtype=torch.float64)
    tried, alike = [], []
    for order, remembered in itertools.product(SHARES, REMEMBERED):
        time_s = -step / math.log(remembered)
        if time_s > LIMITS.told_by_window * span_s and remembered > REMEMBERED[0]:
            continue  # a curve, which the polynomials take away: its size would be a guess
        tried += [CorrelatedNoise(share, time_s, order=order) for share in SHARES[order]]
        alike += [1 + 2 * float(matern(gaps, time_s, order).sum())] * len(SHARES[order])
    found = []
    for noise, far, (likelihood, size) in zip(tried, alike, _likelihoods(windows, tried), strict=True):
        slow = size**2 * (1 - noise.share + noise.share * far)
        found.append((2 * (likelihood - alone), slow, noise, size))
    most, _, _, likeliest = max(found)
    # forces are found from slow changes, where windows show the errors least: the larger slow part is the safe choice
    likely = [(slow, noise, size) for evidence, slow, noise, size in found if evidence > most - LIMITS.likely]
    _, noise, size = max(likely)
    return _Found(noise._replace(size=size / likeliest), likeliest, most)


def windows_of(whole: Observations, flight: Sequence[Segment], kind: int, std: float) -> list[Windows]:
    """Return windows of flights, those of equal frame times as one, without such as are wrong.

    Args:
        whole: The episodes (E).
        flight: Their flight segments.
        kind: 0 for positions, 1 for rotations.
        std: Standard deviation of the tracks, beside errors of the frames' times.
    """
    windows = _windows(whole, flight, kind, std)
    if not windows:
        return []
    sizes = np.concatenate([w.variances for w in windows])
    kept = [w.without(LIMITS.wrong * float(np.median(sizes))) for w in windows]
    return [w.merged() for w in kept if len(w.left)]


@dataclass(frozen=True)
class _Found:
    """The noise of one kind."""

    noise: CorrelatedNoise
    """The likeliest noise model."""
    std: float
    """Standard deviation of one frame [m or rad]."""
    evidence: float
    """Twice the gain in log-likelihood over white noise."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows (W) of n frames each, less the polynomials of d coefficients that fit them best."""

    times_s: Array
    """Frame times, shape (W, n) [s]."""
    basis: Array
    """Orthonormal basis of the polynomials, shape (W, n, d)."""
    left: Array
    """What the polynomials leave of the measurements, shape (W, n, c) [m or rad]."""
    columns: Array
    """Number of the measured columns of each window, shape (W,); further ones are zero."""
    timed: Array | None = None
    """Variances that errors of times add, in units of that of the others, shape (W, n, c); None where times are
    right."""

    @property
    def both(self) -> Array:
        """Basis and residuals side by side, shape (W, n, d + c)."""
        return np.concatenate((self.basis, self.left), 2)

    @property
    def gaps_s(self) -> Array:
        """Times between frames, shape (W, n, n) [s]."""
        return np.abs(self.times_s[:, :, None] - self.times_s[:, None])

    @property
    def dof(self) -> Array:
        """Degrees of freedom of each window (W,)."""
        return (self.left.shape[1] - self.basis.shape[2]) * self.columns

    @property
    def count(self) -> int:
        """Degrees of freedom of all windows."""
        return int(self.dof.sum())

    @property
    def variances(self) -> Array:
        """Variance of each window (W,)."""
        return np.asarray((self.left**2).sum((1, 2)) / self.dof)

    def without(self, above: float) -> Windows:
        """Return the windows whose variance is at most a limit."""
        kept = self.variances <= above
        timed = None if self.timed is None else self.timed[kept]
        return Windows(self.times_s[kept], self.basis[kept], self.left[kept], self.columns[kept], timed)

    def merged(self) -> Windows:
        """Return the windows with those of equal frame times as one: their covariance is decomposed once.

        Beside errors of times each column has a covariance of its own, and becomes a window.
        """
        if self.timed is not None:
            every = self.left.shape[2]
            left, timed = (part.swapaxes(1, 2).reshape(-1, part.shape[1], 1) for part in (self.left, self.timed))
            times, basis = (part.repeat(every, 0) for part in (self.times_s, self.basis))
            return Windows(times, basis, left, np.ones(len(left)), timed)
        grids = np.rint((self.times_s - self.times_s[:, :1]) / RESOLUTION_S)
        _, first, place = np.unique(grids, axis=0, return_index=True, return_inverse=True)
        groups = [self.left[place == k].swapaxes(0, 1).reshape(self.left.shape[1], -1) for k in range(len(first))]
        columns = np.array([group.shape[1] for group in groups])
        padded = [np.pad(group, ((0, 0), (0, columns.max() - group.shape[1]))) for group in groups]
        return Windows(self.times_s[first], self.basis[first], np.stack(padded), columns)


def _likelihoods(windows: Sequence[Windows], noises: Sequence[CorrelatedNoise]) -> list[tuple[float, float]]:
    """Return the largest restricted log-likelihood of each of some noise models, and its standard deviation."""
    largest = max(w.times_s.shape[1] * (w.times_s.shape[1] + w.both.shape[2]) * len(w.both) for w in windows)
    some = max(1, MOST_NUMBERS // largest)
    chunks = [noises[first : first + some] for first in range(0, len(noises), some)]
    return [one for chunk in chunks for one in _likelihoods_together(windows, chunk)]


def _likelihoods_together(windows: Sequence[Windows], noises: Sequence[CorrelatedNoise]) -> list[tuple[float, float]]:
    """Return what `_likelihoods` does, in one batch."""
    laws = list(dict.fromkeys((noise.time_s, noise.order) for noise in noises))
    which = [laws.index((noise.time_s, noise.order)) for noise in noises]
    share = torch.tensor([noise.share for noise in noises], dtype=torch.float64)[:, None, None, None]

    def covariance(w: Windows) -> Tensor:
        gap = torch.from_numpy(w.gaps_s)
        found = with_white(torch.stack([matern(gap, *law) for law in laws])[which], share)
        return found if w.timed is None else found + torch.diag_embed(torch.from_numpy(w.timed[:, :, 0]))

    return restricted_likelihoods(windows, covariance)


def restricted_likelihoods(
    windows: Sequence[Windows], covariance: Callable[[Windows], Tensor]
) -> list[tuple[float, float]]:
    """Return the largest restricted log-likelihoods of some laws of errors, and their standard deviations.

    Of the residuals of polynomials B of a covariance C: of the dof of all their contrasts, whose covariance has the
    determinant |C| |B' C^-1 B| (Harville 1974). That of a matrix that is no covariance is minus infinity.

    Args:
        windows: The windows.
        covariance: Returns the correlations of windows (W) of n frames under each law, shape (N, W, n, n).
    """
    square, logs = 0.0, 0.0
    for w in windows:
        correlation = covariance(w)
        factor = torch.linalg.cholesky_ex(correlation).L
        whitened = torch.linalg.solve_triangular(factor, torch.from_numpy(w.both), upper=False)
        basis, left = whitened.tensor_split([w.basis.shape[2]], 3)
        inner = torch.linalg.cholesky_ex(basis.mT @ basis).L
        along = torch.linalg.solve_triangular(inner, basis.mT @ left, upper=False)
        square = square + (left.square().sum((1, 2, 3)) - along.square().sum((1, 2, 3))).numpy()
        roots = [one.diagonal(dim1=2, dim2=3).log().sum(2) for one in (factor, inner)]
        logs = logs + 2 * ((roots[0] + roots[1]) @ torch.from_numpy(w.columns).to(correlation)).numpy()
    count = sum(w.count for w in windows)
    variance = np.maximum(np.asarray(square) / max(count, 1), 0.0)
    likelihood = -0.5 * (logs + count * np.log(np.maximum(variance, 1e-300)))
    likelihood = np.where(np.isnan(likelihood), -np.inf, likelihood)
    return list(zip(likelihood.tolist(), np.sqrt(variance).tolist(), strict=True))


def _windows(whole: Observations, flight: Sequence[Segment], kind: int, std: float) -> list[Windows]:
    """Return the windows of all flights, grouped by length and degree; `std`: standard deviation of the tracks."""
    mask = (whole.seen, whole.has_orientation)[kind]
    found: dict[tuple[int, int, int], list[tuple[Array, ...]]] = {}
    for segment in flight:
        for column in range(len(whole.free)):
            frames = torch.arange(segment.first, segment.last + 1)
            frames = frames[mask[segment.episode, frames, column] > 0]
            length, degree = _window(whole, segment.episode, column, frames, kind)
            if length < degree + 1 + LEAST:
                continue
            axes = whole.measured_axes[segment.episode, column].numpy() > 0
            for start in range(0, len(frames) - length + 1, length):
                chosen = frames[start : start + length]
                t = whole.times_s[segment.episode, chosen].numpy()
                if kind == 0:
                    values = whole.position_m[segment.episode, chosen, column].numpy()[:, axes]
                else:
                    quat = whole.quat_wxyz[segment.episode, chosen, column]
                    values, axes = quat_turn(quat[length // 2], quat).numpy(), np.ones(3, bool)
                timed: tuple[Array, ...] = ()
                if whole.time_shift is not None:
                    shift = whole.time_shift[segment.episode, chosen, column, 3 * kind : 3 * kind + 3].numpy()[:, axes]
                    turn = np.linalg.svd(shift, full_matrices=False)[2].T  # across the motion there are no such errors
                    values, timed = values @ turn, ((shift @ turn / std) ** 2,)
                scaled = 2 * (t - t[0]) / (t[-1] - t[0]) - 1
                basis = np.linalg.qr(np.vander(scaled, degree + 1))[0]
                left = values - basis @ (basis.T @ values)
                found.setdefault((length, degree, values.shape[1]), []).append((t, basis, left, *timed))
    stacked = [[np.stack(parts) for parts in zip(*some, strict=True)] for some in found.values()]
    return [Windows(t, basis, left, np.full(len(t), left.shape[2]), *timed) for t, basis, left, *timed in stacked]


def _window(whole: Observations, episode: int, column: int, frames: Tensor, kind: int) -> tuple[int, int]:
    """Return the number of frames of the windows of a flight, and the degree of its polynomials."""
    if len(frames) < LEAST_DEGREE + 1 + LEAST:
        return 0, LEAST_DEGREE
    times, known = whole.times_s[episode, frames], frames[whole.has_orientation[episode, frames, column] > 0]
    spin = 0.0
    if len(known) > 1:
        quat = whole.quat_wxyz[episode, known, column]
        turns = quat_turn(quat[:-1], quat[1:]).norm(dim=-1)
        spin = float((turns / whole.times_s[episode, known].diff()).median())
    longest = min(LONGEST_S, LARGEST_TURN / max(spin, 1e-9)) if kind else LONGEST_S
    number = max(1, -(-float(times[-1] - times[0]) // longest))
    length = int(len(frames) // number)
    turn = spin * float(times[max(length - 1, 0)] - times[0])
    # Chebyshev's series of exp(i turn x / 2) on [-1, 1]: the first term left out has 2 (turn / 4)^n / n!
    degree = next((d for d in range(LEAST_DEGREE, MOST_DEGREE) if _circle_left(turn, d) < CIRCLE_LEFT), MOST_DEGREE)
    return length, degree


def _circle_left(turn: float, degree: int) -> float:
    """Return the residual of a unit circle over a turn [rad] after its Chebyshev series of a degree."""
    return 2 * (turn / 4) ** (degree + 1) / math.factorial(degree + 1)


@dataclass(frozen=True)
class WindowErrors:
    """Variance and lag-one autocorrelation of the residuals of fitted windows (B).

    A model that misses something bends a whole episode, and smoothed tracks have similar errors for several frames. As
    for a first-order autoregression of correlation rho from frame to frame, (1 - rho) / (1 + rho) of the frames count.
    """

    chi2: Array
    """Weighted sum of squares, shape (B,)."""
    count: Array
    """Weighted number of residuals less those of the state, shape (B,)."""
    kind: NDArray[np.int64]
    """1 for ends of episodes, 0 for other windows, shape (B,)."""
    inflation: Array
    """Variance inflation (1 + rho) / (1 - rho) by kind, shape (2,)."""

    @property
    def independent(self) -> Array:
        """Effective sample size (B,) of each window."""
        return self.count / self.inflation[self.kind]

    def factor(self, numbers: int) -> tuple[float, float]:
        """Return the factor, at least 1, by which the error variance exceeds the assumed one, and its dof.

        Args:
            numbers: Count of fitted parameters, without the states.
        """
        dof = max(float(self.independent.sum()) - numbers, 1.0)
        return max(float(self.chi2.sum()) / dof, 1.0), dof

    @staticmethod
    def of(rows: Tensor, solution: Solution, batch: Observations, ends: NDArray[np.bool_]) -> WindowErrors:
        """Measure the residuals of fitted windows.

        Args:
            rows: Residuals (B, F, 6) at the solution, in assumed standard deviations.
            solution: Of the fit, which weighted them robustly.
            batch: The windows.
            ends: Windows (B,) that are ends of episodes: their errors are estimated separately.
        """
        weight = (1 / (1 + solution.chi2 / ROBUST_SCALE**2)).unflatten(1, (-1, len(batch.free)))
        r = rows.unflatten(1, (-1, len(batch.free)))
        known = torch.cat(
            (
                batch.seen[..., None] * batch.measured_axes[:, None],
                batch.has_orientation[..., None].expand(-1, -1, -1, 3),
            ),
            -1,
        )
        count = (weight[..., None] * known).sum(1)
        count = (count - 2 * (known.sum(1) > 0)).clamp_min(0.0).sum((1, 2))
        chi2 = (weight[..., None] * r.square() * known).sum((1, 2, 3))
        pairs = torch.minimum(weight[:, 1:], weight[:, :-1])[..., None] * known[:, 1:] * known[:, :-1]
        product = (pairs * r[:, 1:] * r[:, :-1]).sum((1, 2, 3))
        square = 0.5 * (pairs * (r[:, 1:].square() + r[:, :-1].square())).sum((1, 2, 3))
        kind = ends.astype(np.int64)
        inflation = np.ones(2)
        for k in np.unique(kind):
            rho = float(product[kind == k].sum() / square[kind == k].sum().clamp_min(1e-300))
            rho = min(max(rho, 0.0), MOST_CORRELATED)
            inflation[k] = (1 + rho) / (1 - rho)
        return WindowErrors(chi2.numpy(), count.numpy(), kind, inflation)
