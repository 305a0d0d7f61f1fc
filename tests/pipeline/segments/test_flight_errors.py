"""Variance components of flights: the likelihood is a dense covariance's, and simulated errors are found again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.segments.flight_contrasts import Components, FlightContrasts, _spanned, _spread_frames  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.segments.variance_components import _climbed  # pyright: ignore[reportMissingImports]
from cgwm.pipeline.trajectories.correlated_noise import _likelihood, _Windows
from cgwm.pipeline.trajectories.innovations import FALLS, CorrelatedNoise, matern
from scipy.signal import butter, filtfilt

F64 = torch.float64
RATE_HZ, FRAMES = 200.0, 32


def contrasts_of(errors: np.ndarray, common: torch.Tensor | None = None) -> FlightContrasts:
    """Errors (B, n, 3) of flights whose place and velocity are free."""
    flights, frames, _ = errors.shape
    times = (torch.arange(frames, dtype=F64) / RATE_HZ).expand(flights, -1)
    own = torch.zeros(flights, frames, 3, 6, dtype=F64)
    for axis in range(3):
        own[:, :, axis, axis], own[:, :, axis, 3 + axis] = 1.0, times - times.mean()
    rows = torch.as_tensor(errors)
    nothing = own[..., :0] if common is None else common
    return FlightContrasts(
        times, torch.ones(flights, frames, dtype=F64), rows, own, nothing, torch.ones(flights, 3, dtype=F64)
    )


def drawn(order: float, time_s: float, white: float, flights: int = 24, seed: int = 0) -> np.ndarray:
    """Errors of variance 1, a part of it white."""
    rng = np.random.default_rng(seed)
    t = torch.arange(FRAMES, dtype=F64) / RATE_HZ
    covariance = (1 - white) * matern((t[:, None] - t).abs(), time_s, order) + (white + 1e-9) * torch.eye(
        FRAMES, dtype=F64
    )
    return np.einsum(
        "ij,bja->bia", torch.linalg.cholesky(covariance).numpy(), rng.standard_normal((flights, FRAMES, 3))
    )


def slow_power(noise: CorrelatedNoise) -> float:
    """The variance of the mean of many frames, times their number: what a slow force is weighed against."""
    gaps = torch.arange(1, 2000, dtype=F64) / RATE_HZ
    alike = 1 + 2 * float(matern(gaps, noise.time_s, noise.order).sum())
    return noise.size**2 * (noise.share * alike + 1 - noise.share)


def test_the_likelihood_of_flights_is_that_of_a_dense_covariance() -> None:
    rng = np.random.default_rng(3)
    common = torch.as_tensor(rng.standard_normal((2, 9, 3, 2)))
    one = contrasts_of(rng.standard_normal((2, 9, 3)), common)
    one.mask[1, 7:] = 0
    for values in (one.rows, one.own, one.common):
        values[1, 7:] = 0
    values = [torch.tensor(v, dtype=F64) for v in (0.3, 0.8, 0.02, 2.0, 0.3, 900.0)]
    for order in FALLS:
        white, fast, time_s, slow, slow_time_s, sway = values
        sizes = Components(white, fast, time_s, order, slow, slow_time_s, sway)
        blocks, design, y = [], [], []
        for k, count in enumerate((9, 7)):
            t = one.times_s[k, :count]
            gap, path = (t[:, None] - t).abs(), 0.5 * (t - t[0]).square()
            plain = fast * matern(gap, 0.02, order) + slow * torch.exp(-gap / 0.3) + (white + 1e-6) * torch.eye(count)
            for axis in range(3):
                blocks.append(plain + (sway * path[:, None] * path if axis < 2 else 0))
                zeros = [torch.zeros(count, 6, dtype=F64) for _ in range(2)]
                zeros[k] = one.own[k, :count, axis]
                design.append(torch.cat((*zeros, one.common[k, :count, axis]), 1))
                y.append(one.rows[k, :count, axis])
        root = torch.linalg.cholesky(torch.block_diag(*blocks))
        x, left = (
            torch.linalg.solve_triangular(root, v, upper=False) for v in (torch.cat(design), torch.cat(y)[:, None])
        )
        normal = x.mT @ x
        square = left.square().sum() - (x.mT @ left).mT @ torch.linalg.solve(normal, x.mT @ left)
        dense = -0.5 * (2 * root.diagonal().log().sum() + torch.linalg.slogdet(normal)[1] + square)
        torch.testing.assert_close(one.likelihood(sizes, (0, 1)), dense[0, 0], rtol=1e-6, atol=1e-6)


def test_the_likelihood_of_windows_is_that_of_their_contrasts() -> None:
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0, 0.2, 14))
    every = np.linalg.qr(np.vander(t, 5), mode="complete")[0]
    basis, rest = every[:, :5], every[:, 5:]
    values = rng.standard_normal((14, 3))
    left = values - basis @ (basis.T @ values)
    for order in FALLS:
        alike = matern(torch.as_tensor(np.abs(t[:, None] - t)), 0.03, order).numpy()
        covariance = rest.T @ (0.7 * alike + 0.3 * np.eye(14)) @ rest
        square = float(np.einsum("ia,ij,ja->", rest.T @ values, np.linalg.inv(covariance), rest.T @ values))
        known = -0.5 * (3 * np.linalg.slogdet(covariance)[1] + 27 * np.log(square / 27))
        found, std = _likelihood([_Windows(t[None], basis[None], left[None])], CorrelatedNoise(0.7, 0.03, order=order))
        assert found == pytest.approx(known, rel=1e-9) and std == pytest.approx(np.sqrt(square / 27), rel=1e-9)


def likeliest(contrasts: FlightContrasts) -> CorrelatedNoise:
    start = [(-1.0, 0.0, np.log(0.02))]
    return max((_climbed(contrasts, start, (), (0, 1), order) for order in FALLS), key=lambda one: one[1])[0]


@pytest.mark.parametrize("order", FALLS)
def test_simulated_errors_are_found_again(order: float) -> None:
    true, found = CorrelatedNoise(share=0.9, time_s=0.02, order=order), likeliest(contrasts_of(drawn(order, 0.02, 0.1)))
    assert found.size == pytest.approx(1.0, rel=0.1)
    # 24 flights of 0.16 s tell the slow part within a sixth
    assert slow_power(found) == pytest.approx(slow_power(true), rel=0.33)


def test_low_passed_errors_are_found_again() -> None:
    rng = np.random.default_rng(5)
    coefficients: Any = butter(2, 25.0, fs=RATE_HZ)
    every = np.asarray(filtfilt(*coefficients, rng.standard_normal((24, 5 * FRAMES, 3)), axis=1))
    contrasts = contrasts_of(every[:, 2 * FRAMES : 5 * FRAMES].copy())
    picked = _spread_frames(contrasts.mask[0], contrasts.times_s[0], 0.01)
    assert picked.tolist() == list(range(0, 3 * FRAMES, 2))
    thin = replace(
        contrasts, **{k: getattr(contrasts, k)[:, picked] for k in ("times_s", "mask", "rows", "own", "common")}
    )
    found = likeliest(thin)
    assert found.order == 2.5
    # a low pass leaves slow changes as they were: size 1. Of all frames it is 8, as the law of fast changes is another
    assert 0.5 < slow_power(found) < 2.0


def test_white_errors_are_found_again() -> None:
    found = likeliest(contrasts_of(drawn(0.5, 0.02, 1.0)))
    assert slow_power(found) == pytest.approx(1.0, rel=0.33)


def test_an_effect_that_moves_nothing_explains_nothing() -> None:
    errors = drawn(0.5, 0.02, 0.5)
    contrasts = contrasts_of(errors)
    # a tilt of the frame turns what it leaves: derivatives proportional to the residuals, however small
    nothing = 1e-5 * contrasts.rows[..., None]
    assert _spanned(nothing, contrasts.own).shape[-1] == 0
    assert _spanned(1e5 * nothing, contrasts.own).shape[-1] == 1
