"""Bursts: rows of wrong measurements within a motion, whose frames before and after them lie on one smooth path.

What nothing pushes follows a low polynomial, its marker with what the measured turn adds, and both sides of a wrong row
lie on the same one; after a contact they do not. Leaving out frames R lowers the sum of squares of a linear fit with
residuals e and projector H by e_R' (1 - H_RR)^-1 e_R, whatever was measured there. A row is wrong where this is more
than `LIMITS.burst_share` times what its frames have elsewhere, what is left of the flight is as quiet as others, and no
change of the velocity within the row explains it better. A body on the ground follows such a path between impacts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.rotation import continuous_turns, quat_to_matrix
from .observations import Observations
from .segmentation import Segment
from .thresholds import TRACK_THRESHOLDS
from .track_noise import FLOOR_M, FLOOR_RAD, MAD_TO_STD, Noise, moves

LIMITS = TRACK_THRESHOLDS.track_noise
Array = NDArray[np.float64]

DEGREES = (3, 4)
"""Degree of the polynomial of a marker whose turn is measured, and of all else: drag and lift bend a fall."""
KEPT, ROUNDING = 1e-3, 1e-6
"""Smallest share of the largest singular value of the functions of a path that counts, and what keeps a factor real."""
LEAST_TURNED = 0.5
"""Share of the frames whose turn is measured from which that of the others is interpolated."""
LEAST_FREE = 8
"""Fewest frames of a flight beside a burst and the coefficients of its path."""
GROUNDED_S = 0.3
"""Length [s] of the half-overlapping pieces of a motion on the ground that are looked at, three of the longest bursts.
"""


@dataclass(frozen=True, kw_only=True)
class _Path:
    """One kind of measurement of one flight, and the smooth paths that it may follow."""

    episode: int
    """Index of the episode."""
    column: int
    """The body."""
    frames: NDArray[np.int64]
    """Measured frames (n)."""
    time_s: Array
    """Their times (n) [s]."""
    values: Array
    """Coordinates (n, c) [m or rad]."""
    basis: Array
    """Functions of time that each coordinate may follow, (c, n, q)."""
    free_s: float
    """Time from which rows may be wrong [s]: before, a hand may still hold the body (`release_detection`)."""

    def without(self, wrong: NDArray[np.bool_]) -> _Path:
        """Leave out frames."""
        kept = ~wrong
        return replace(
            self,
            frames=self.frames[kept],
            time_s=self.time_s[kept],
            values=self.values[kept],
            basis=self.basis[:, kept],
        )

    def fitted(self) -> tuple[Array, Array]:
        """Return residuals (n, c), and the projectors (c, n, n) on the paths."""
        length = np.linalg.norm(self.basis, axis=1, keepdims=True)
        u, s, _ = np.linalg.svd(self.basis / np.where(length > 0, length, 1.0), full_matrices=False)
        u = u * (s > KEPT * s.max(1, keepdims=True))[:, None]
        projector = u @ u.swapaxes(1, 2)
        return self.values - np.einsum("cij,jc->ic", projector, self.values), projector

    def square(self) -> float:
        """Return the sum of squares of the residuals."""
        return float(np.square(self.fitted()[0]).sum())

    def bent_at(self, at_s: float) -> _Path:
        """Return the measurements with paths that may change their velocity at a time [s]."""
        late = np.maximum(self.time_s - at_s, 0.0)
        return replace(
            self, basis=np.concatenate((self.basis, np.broadcast_to(late[:, None], (len(self.basis), len(late), 1))), 2)
        )

    @property
    def free(self) -> int:
        """Number of frames beside the coefficients."""
        return len(self.frames) - self.basis.shape[2]


def bursts(
    whole: Observations, flight: Sequence[Segment], noise: Noise, kind: int
) -> Iterator[tuple[int, NDArray[np.int64], int]]:
    """Yield episode, frames and body of the bursts in flights.

    Args:
        whole: The episodes.
        flight: Their flights.
        noise: Standard deviations of the tracks, beside which errors of times count.
        kind: 0 for positions, 1 for rotations.
    """
    every = range(len(whole.free))
    paths = [path for item in flight for k in every if (path := _path(whole, item, k, kind, noise[kind]))]
    sigma = max(_usual(paths), (FLOOR_M, FLOOR_RAD)[kind])
    for path in paths:
        found = _found(path, sigma)
        if len(found):
            yield path.episode, found, path.column


def without_grounded_bursts(whole: Observations, airborne: Tensor, noise: Noise) -> Observations:
    """Mark the bursts of motions on the ground as not measured.

    Args:
        whole: The episodes (E).
        airborne: Airborne frames (E, T).
        noise: Standard deviations of the tracks.
    """
    pieces = list(_grounded(whole, airborne))
    seen, turned = whole.seen.clone(), whole.has_orientation.clone()
    for kind in (1, 0):  # a wrong turn would move a marker beside the centre of mass
        whole = replace(whole, seen=seen.clone(), has_orientation=turned.clone())
        for episode, frames, column in bursts(whole, pieces, noise, kind):
            (seen, turned)[kind][episode, frames, column] = 0.0
    return replace(whole, seen=seen, has_orientation=turned)


def _grounded(whole: Observations, airborne: Tensor) -> Iterator[Segment]:
    """Yield half-overlapping pieces of the motions on the ground."""
    for episode, times in enumerate(whole.times_s.numpy()):
        frames = np.flatnonzero((~airborne[episode] & (whole.seen[episode].amax(-1) > 0)).numpy())
        if len(frames) < 2:
            continue
        length = round(GROUNDED_S / float(np.median(np.diff(times[frames]))))
        for run in np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1):
            last = max(len(run) - 1 - length, 0)
            for first in sorted({*range(0, last, max(length // 2, 1)), last}):
                yield Segment(episode, int(run[first]), int(run[min(first + length, len(run) - 1)]))


def _path(whole: Observations, item: Segment, column: int, kind: int, std: float) -> _Path | None:
    """Return a flight's measurements of one kind; None of too few.

    Beside errors of times they are divided by what these add to errors of a standard deviation `std`.
    """
    frames = torch.arange(item.first, item.last + 1)
    masks = (whole.seen, whole.has_orientation)
    frames = frames[masks[kind][item.episode, frames, column] > 0]
    known = masks[1][item.episode, frames, column].numpy() > 0
    turned = bool(known.mean() > LEAST_TURNED) if len(known) else False
    times = whole.times_s[item.episode, frames]
    if len(frames) < LEAST_FREE + 2 * LIMITS.burst_sides[0]:
        return None
    quat = whole.quat_wxyz[item.episode, frames, column]
    t = times.numpy()
    scaled = (t - t.mean()) / (t[-1] - t[0])
    powers = np.vander(scaled, DEGREES[0 if kind == 0 and turned else 1] + 1)
    axes = np.ones(3, bool)
    if kind == 0:
        axes = moves(whole.position_m[item.episode, whole.seen[item.episode, :, column] > 0, column].numpy())
        values = whole.position_m[item.episode, frames, column].numpy()[:, axes]
    else:
        values = continuous_turns(times, quat, reference=torch.tensor(len(frames) // 2)).numpy()
    basis = np.broadcast_to(powers, (int(axes.sum()), *powers.shape))
    if kind == 0 and turned:
        # a marker beside the centre of mass turns with the body
        turn = filled_by_cubics(t, quat_to_matrix(quat).numpy(), known)[:, axes].swapaxes(0, 1)
        basis = np.concatenate((basis, turn), 2)
    opens = item.first <= int((whole.seen[item.episode].amax(-1) > 0).to(torch.int64).argmax())
    free_s = t[0] + LIMITS.longest_burst_s * opens
    values = values.astype(np.float64)
    if whole.time_shift is not None:
        shift = whole.time_shift[item.episode, frames, column, 3 * kind : 3 * kind + 3].numpy()[:, axes]
        more = np.hypot(1.0, shift / std)
        values, basis = values / more, basis / more.T[..., None]
    path = _Path(
        episode=item.episode,
        column=column,
        frames=frames.numpy(),
        time_s=t,
        values=values,
        basis=basis,
        free_s=free_s,
    )
    return path if path.free >= LEAST_FREE else None


def filled_by_cubics(times_s: Array, values: Array, known: NDArray[np.bool_]) -> Array:
    """Return values (n, ...) at times (n,) [s]; one that is not known by Lagrange's cubic through four known ones.

    They are the two nearest on each side, at the ends the four nearest.
    """
    if known.all():
        return values
    missing, t = np.flatnonzero(~known), times_s[known]
    first = np.clip(np.searchsorted(np.flatnonzero(known), missing) - 2, 0, len(t) - 4)
    chosen = first[:, None] + np.arange(4)
    own = np.eye(4, dtype=bool)
    between = t[chosen][:, :, None] - t[chosen][:, None]
    beyond = (times_s[missing, None] - t[chosen])[:, None]
    weights = (np.where(own, 1.0, beyond) / np.where(own, 1.0, between)).prod(-1)
    filled = values.copy()
    filled[missing] = np.einsum("mk,mk...->m...", weights, values[known][chosen])
    return filled


def _usual(paths: Sequence[_Path]) -> float:
    """Return the robust standard deviation of what paths leave; 0 without any."""
    left = []
    for path in paths:
        away, projector = path.fitted()
        left.append((away / np.sqrt((1 - projector.diagonal(axis1=1, axis2=2)).clip(1e-3)).T).ravel())
    return MAD_TO_STD * float(np.median(np.abs(np.concatenate(left)))) if left else 0.0


def _found(path: _Path, sigma: float) -> NDArray[np.int64]:
    """Return the frames of the bursts of a flight; none where the rest of it is not as quiet as usual, or bends."""
    every, wrong, middle_s = path, [], []
    for _ in range(int(LIMITS.burst_most[0])):
        row = _worst(path, sigma)
        if row is None:
            break
        if row.sum() >= LIMITS.least_burst:
            wrong.append(path.frames[row])
            middle_s.append(float(path.time_s[row].mean()))
        path = path.without(row)
    none = every.frames[:0]
    if not wrong or path.free < LEAST_FREE or len(path.frames) < (1 - LIMITS.burst_most[1]) * len(every.frames):
        return none
    left, axes = path.square() / sigma**2, path.values.shape[1]
    bends = max(left - path.bent_at(at).square() / sigma**2 for at in middle_s)
    touched = left > LIMITS.burst_rest * path.free * axes or bends > LIMITS.burst_share * axes
    return none if touched else np.sort(np.concatenate(wrong))


def _worst(path: _Path, sigma: float) -> NDArray[np.bool_] | None:
    """Return the row of frames (n) that most exceeds the usual errors; None where none does."""
    away, projector = path.fitted()
    count, axes = away.shape
    step = float(np.median(np.diff(path.time_s)))
    side = max(int(LIMITS.burst_sides[0]), round(LIMITS.burst_sides[1] / step))
    longest = min(1 + int(LIMITS.longest_burst_s / step), path.free - LEAST_FREE, count - 2 * side)
    starts = np.arange(max(side, int(np.searchsorted(path.time_s, path.free_s))), count - side)
    if longest < 1 or not len(starts):
        return None
    rows = starts[:, None] + np.arange(longest)
    inside = rows < count - side
    rows = rows.clip(max=count - 1)
    pairs = rows[:, :, None], rows[:, None, :]
    block = (np.eye(count) - projector)[:, *pairs] * (inside[:, :, None] & inside[:, None, :])
    block += np.eye(longest) * np.where(inside, ROUNDING, 1.0)[:, None, :]
    # a factor's leading part is the factor of the leading part: one gives all lengths of a row
    own = np.linalg.solve(np.linalg.cholesky(block), (away[rows] * inside[..., None]).transpose(2, 0, 1)[..., None])
    falls = np.square(own[..., 0]).sum(0).cumsum(1) / sigma**2
    size = np.arange(1, longest + 1) * axes
    excess = np.where(inside, falls - LIMITS.burst_share * size, -np.inf)
    place = np.unravel_index(int(excess.argmax()), excess.shape)
    if excess[place] <= 2 * np.log(excess.size):
        return None
    row = np.zeros(count, bool)
    row[rows[place[0], : place[1] + 1]] = True
    return row
