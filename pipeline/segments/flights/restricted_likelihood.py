"""The restricted likelihood of variance components, with its slope and information.

It is that of the residuals after generalised least squares with flat priors on states and effects (Patterson & Thompson
1971; Harville 1974). With P the inverse covariance less what states and effects take of it, and V_k the derivative of
the covariance by coordinate k, the slope is (y' P V_k P y - tr P V_k) / 2, and the average of the observed and the
expected information is y' P V_j P V_k P y / 2 (Gilmour, Thompson & Cullis 1995), which needs no trace of products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...trajectories.innovations import CorrelatedNoise, matern, matern_by_time
from .contrasts import FlightContrasts

Array = NDArray[np.float64]

LEAST_WHITE = 0.03
"""Smallest variance of the white noise beside that of the fast process: what a filter leaves of fast changes is less
than any process of a finite order has, and would decide how large the slow ones are."""


class Components(NamedTuple):
    """Variance components: variances in units of that of the tracks, and times [s]."""

    white: float
    """Variance of the white noise."""
    fast: float
    """Variance of the fast process."""
    time_s: float
    """Its correlation time."""
    order: float
    """Its order."""
    slow: float | None = None
    """Variance of the slow process."""
    slow_time_s: float = 1.0
    """Its correlation time."""
    sway: float | None = None
    """Variance of the flights' own accelerations, in units of the tracks' per s4."""

    @staticmethod
    def of(z: Array, kinds: Sequence[str], order: float) -> Components:
        """Return the components of coordinates: logarithms of standard deviations and times.

        Args:
            z: Of white noise (beside `LEAST_WHITE`) and of the fast process with its time; then of the slow process
                with its time, and of the flights' own accelerations.
            kinds: Which of "slow" and "sway" follow.
            order: Of the fast process.
        """
        white, fast, time, *rest = (float(x) for x in z)
        slow, slow_time = (rest.pop(0), rest.pop(0)) if "slow" in kinds else (None, 0.0)
        sway = rest.pop(0) if "sway" in kinds else None
        return Components(
            white=np.exp(2 * white) + LEAST_WHITE * np.exp(2 * fast),
            fast=np.exp(2 * fast),
            time_s=np.exp(time),
            order=order,
            slow=None if slow is None else np.exp(2 * slow),
            slow_time_s=np.exp(slow_time),
            sway=None if sway is None else np.exp(2 * sway),
        )

    def noise(self, level: tuple[int, ...]) -> CorrelatedNoise:
        """Return the noise model."""
        whole = self.white + self.fast
        return CorrelatedNoise(
            share=self.fast / whole,
            time_s=self.time_s,
            size=float(np.sqrt(whole)),
            slow=float(np.sqrt(self.slow or 0.0)),
            slow_time_s=self.slow_time_s,
            sway=float(np.sqrt(self.sway or 0.0)),
            level=level or (0, 1),
            order=self.order,
        )


class Scored(NamedTuple):
    """The restricted likelihood at some components."""

    value: float
    """Its logarithm, up to a constant."""
    slope: Array
    """Its derivatives (k,) by the coordinates of `Components.of`."""
    information: Array
    """Average information (k, k)."""


class _Axes(NamedTuple):
    """What the likelihood needs of axes that share a covariance; flights (B), frames (n), axes (a)."""

    slopes: Tensor
    """Derivatives of the covariance by each coordinate, shape (k, B, n, n)."""
    inverse: Tensor
    """Inverse covariance, shape (B, n, n)."""
    log: float
    """Logarithm of the determinants of the covariances of all measured axes."""
    columns: Tensor
    """Derivatives by the states, residuals and common directions, shape (B, n, a, all)."""
    weighed: Tensor
    """The same times the inverse covariance."""
    counted: Tensor
    """Number of measured axes, shape (B,)."""


@dataclass(frozen=True, eq=False)
class RestrictedLikelihood:
    """The restricted likelihood of the variance components of flights."""

    flights: FlightContrasts
    """Residuals, with what states and effects can follow."""
    level: tuple[int, ...]
    """Axes across gravity."""

    def at(self, sizes: Components) -> Scored:
        """Return the likelihood and its derivatives.

        Raises:
            RuntimeError: If a covariance is singular to rounding.
        """
        level = self.level if sizes.sway is not None else ()
        rest = tuple(axis for axis in range(3) if axis not in level)
        alike = (level, rest) if self.flights.timed is None else [(axis,) for axis in range(3)]
        parts = [self._axes(sizes, axes, axes[0] in level) for axes in alike if axes]
        own = self.flights.own.shape[-1]
        normal = torch.stack([torch.einsum("bnac,bnad->bcd", part.columns, part.weighed) for part in parts]).sum(0)
        root = _root(normal[:, :own, :own])
        # of each flight's states, and of the common directions beside these
        take = torch.linalg.solve_triangular(root, normal[:, :own, own:], upper=False)
        left = (normal[:, own:, own:] - take.mT @ take).sum(0)
        common = _root(left[1:, 1:])
        take_row = torch.linalg.solve_triangular(common, left[1:, :1], upper=False)[:, 0]
        square = float(left[0, 0] - take_row.square().sum())
        logs = sum(part.log for part in parts) + 2 * _log(root) + 2 * _log(common)
        return Scored(-0.5 * (logs + square), *_derivatives(parts, own, root, take, common, take_row))

    def _axes(self, sizes: Components, axes: tuple[int, ...], sways: bool) -> _Axes:
        """Return what is needed of some axes, whose covariance has the flights' own accelerations or not."""
        covariance, slopes = self._covariance(sizes, sways)
        if self.flights.timed is not None:
            covariance = covariance + torch.diag_embed(self.flights.mask * self.flights.timed[..., axes[0]])
        root = torch.linalg.cholesky(covariance)
        inverse = torch.cholesky_inverse(root)
        columns = self._columns[:, :, axes]
        weighed = (inverse @ columns.flatten(2)).view_as(columns)
        counted = self.flights.axes[:, axes].sum(1)
        log = 2 * float((root.diagonal(dim1=1, dim2=2).log().sum(1) * counted).sum())
        return _Axes(slopes, inverse, log, columns, weighed, counted)

    def _covariance(self, sizes: Components, sways: bool) -> tuple[Tensor, Tensor]:
        """Return the covariance (B, n, n) of the frames of one axis, and its slopes (k, B, n, n).

        It is the unit matrix where a frame does not count.
        """
        mask = self.flights.mask
        both = mask[:, :, None] * mask[:, None]
        unit = torch.diag_embed(mask)
        fast = sizes.fast * matern(self._gaps, sizes.time_s, sizes.order) * both
        white = sizes.white - LEAST_WHITE * sizes.fast
        slopes = [
            2 * white * unit,
            2 * (fast + LEAST_WHITE * sizes.fast * unit),
            sizes.fast * matern_by_time(self._gaps, sizes.time_s, sizes.order) * both,
        ]
        found = fast + torch.diag_embed(mask * (sizes.white + 1e-6) + (1 - mask))
        if sizes.slow is not None:
            slow = sizes.slow * torch.exp(-self._gaps / sizes.slow_time_s) * both
            slopes += [2 * slow, slow * self._gaps / sizes.slow_time_s]
            found = found + slow
        if sizes.sway is not None:
            path = sizes.sway * self._paths if sways else torch.zeros_like(found)
            slopes.append(2 * path)
            found = found + path
        return found, torch.stack(slopes)

    @cached_property
    def _gaps(self) -> Tensor:
        """Times between frames, shape (B, n, n) [s]."""
        times = self.flights.times_s
        return (times[:, :, None] - times[:, None]).abs()

    @cached_property
    def _paths(self) -> Tensor:
        """Covariance (B, n, n) of the path of an acceleration of variance 1."""
        times = self.flights.times_s
        path = 0.5 * (times - times[:, :1]).square() * self.flights.mask
        return path[:, :, None] * path[:, None]

    @cached_property
    def _columns(self) -> Tensor:
        """Derivatives by the states, residuals and common directions, shape (B, n, 3, all)."""
        one = self.flights
        return torch.cat((one.own, one.rows[..., None], one.common), -1)


def _derivatives(
    parts: Sequence[_Axes], own: int, root: Tensor, take: Tensor, common: Tensor, take_row: Tensor
) -> tuple[Array, Array]:
    """Return slope (k,) and average information (k, k); see the module.

    Args:
        parts: The axes.
        own: Number of states.
        root: Cholesky factors of the normal matrices of the states, shape (B, own, own).
        take: Products of the states, whitened by these, with residuals and common directions.
        common: Cholesky factor of the normal matrix of the common directions beside the states.
        take_row: Products of the common directions, whitened by it, with the residuals.
    """
    count = len(parts[0].slopes)
    slope, information = take_row.new_zeros(count), take_row.new_zeros(count, count)
    by_states, by_common = 0.0, 0.0
    for part in parts:
        flat = part.weighed.transpose(2, 3)  # (B, n, all, a), to solve from the right
        states = _solved(root, flat[:, :, :own])
        beside = flat[:, :, own:] - torch.einsum("bsc,bnsa->bnca", take, states)
        effects = _solved(common, beside[:, :, 1:])
        left = beside[:, :, 0] - torch.einsum("p,bnpa->bna", take_row, effects)
        both = torch.cat((states, effects), 2)
        trace = part.counted[:, None, None] * part.inverse - torch.einsum("bnca,bmca->bnm", both, both)
        moved = part.slopes @ left  # (k, B, n, a)
        slope += torch.einsum("kbna,bna->k", moved, left) - torch.einsum("kbnm,bnm->k", part.slopes, trace)
        information += torch.einsum("jbna,kbna->jk", moved, part.inverse @ moved)
        by_states = by_states + torch.einsum("bnsa,kbna->kbs", states, moved)
        by_common = by_common + torch.einsum("bnpa,kbna->kp", effects, moved)
    for taken in (by_states, by_common):
        if isinstance(taken, Tensor):
            information -= taken.flatten(1) @ taken.flatten(1).mT
    return 0.5 * slope.numpy(), 0.5 * information.numpy()


def _solved(root: Tensor, columns: Tensor) -> Tensor:
    """Return columns (B, n, c, a) combined so that a normal matrix with a Cholesky factor becomes the unit matrix."""
    if not columns.shape[2]:
        return columns
    inverse = torch.linalg.solve_triangular(root, torch.eye(root.shape[-1]).to(root), upper=False)
    return torch.einsum("bdc,bnca->bnda" if inverse.ndim == 3 else "dc,bnca->bnda", inverse, columns)


def _log(root: Tensor) -> float:
    """Return the sum of the logarithms of the diagonals of Cholesky factors."""
    return float(root.diagonal(dim1=-2, dim2=-1).log().sum())


def _root(matrix: Tensor) -> Tensor:
    """Return the Cholesky factor of a normal matrix, with a hint of a prior."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    return torch.linalg.cholesky(matrix + torch.diag_embed(1e-9 * diagonal + 1e-12))
