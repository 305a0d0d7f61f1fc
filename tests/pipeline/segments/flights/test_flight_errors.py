"""Variance components of flights: the likelihood is a dense covariance's, and simulated errors are found again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.pipeline.segments.flights.contrasts import FlightContrasts, _spanned, _spread_frames
from cgwm.pipeline.segments.flights.restricted_likelihood import Components, RestrictedLikelihood
from cgwm.pipeline.segments.flights.variance_components import _climbed
from cgwm.pipeline.trajectories.correlated_noise import Windows, _likelihoods
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


def dense_covariance(one: FlightContrasts, counts: tuple[int, ...], sizes: Components) -> torch.Tensor:
    """The covariance of all residuals, written out."""
    blocks = []
    for times, count in zip(one.times_s, counts, strict=True):
        t = times[:count]
        gap, path = (t[:, None] - t).abs(), 0.5 * (t - t[0]).square()
        plain = sizes.fast * matern(gap, sizes.time_s, sizes.order) + (sizes.white + 1e-6) * torch.eye(count, dtype=F64)
        plain = plain + (sizes.slow or 0.0) * torch.exp(-gap / sizes.slow_time_s)
        blocks += [plain + ((sizes.sway or 0.0) * path[:, None] * path if axis < 2 else 0) for axis in range(3)]
    return torch.block_diag(*blocks)


@pytest.mark.parametrize("order", FALLS)
def test_likelihood_slope_and_information_are_those_of_a_dense_covariance(order: float) -> None:
    rng = np.random.default_rng(3)
    one, counts = (
        contrasts_of(rng.standard_normal((2, 9, 3)), torch.as_tensor(rng.standard_normal((2, 9, 3, 2)))),
        (9, 7),
    )
    one.mask[1, 7:] = 0
    for values in (one.rows, one.own, one.common):
        values[1, 7:] = 0
    kinds, z = ("slow", "sway"), np.array([-0.6, 0.1, np.log(0.02), 0.3, np.log(0.3), 3.4])
    x, y = torch.zeros(48, 14, dtype=F64), torch.cat([one.rows[k, :n].mT.flatten() for k, n in enumerate(counts)])
    for k, n in enumerate(counts):
        own = torch.cat((one.own[k, :n], one.common[k, :n]), -1).transpose(0, 1).flatten(0, 1)
        x[27 * k : 27 * k + 3 * n, [*range(6 * k, 6 * k + 6), 12, 13]] = own
    covariance = dense_covariance(one, counts, Components.of(z, kinds, order))
    moved = [Components.of(z + 1e-5 * np.eye(6)[k] * sign, kinds, order) for k in range(6) for sign in (1, -1)]
    slopes = [dense_covariance(one, counts, sizes) for sizes in moved]
    by_coordinate = [(a - b) / 2e-5 for a, b in zip(slopes[::2], slopes[1::2], strict=True)]
    inverse = torch.linalg.inv(covariance)
    normal = x.mT @ inverse @ x
    left = inverse - inverse @ x @ torch.linalg.solve(normal, x.mT @ inverse)
    value = -0.5 * (torch.logdet(covariance) + torch.logdet(normal) + y @ left @ y)
    slope = [0.5 * (y @ left @ v @ left @ y - (left * v).sum()) for v in by_coordinate]
    information = [[0.5 * y @ left @ a @ left @ b @ left @ y for a in by_coordinate] for b in by_coordinate]
    found = RestrictedLikelihood(one, (0, 1)).at(Components.of(z, kinds, order))
    assert found.value == pytest.approx(float(value), rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(found.slope, slope, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.information, information, rtol=1e-5, atol=1e-5)


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
        window = Windows(t[None], basis[None], left[None], np.array([3]))
        other, (found, std) = _likelihoods(
            [window], [CorrelatedNoise(0.5, 0.01), CorrelatedNoise(0.7, 0.03, order=order)]
        )
        assert other != (found, std)
        assert found == pytest.approx(known, rel=1e-9) and std == pytest.approx(np.sqrt(square / 27), rel=1e-9)


def test_windows_of_equal_times_are_decomposed_once_and_tell_the_same() -> None:
    rng = np.random.default_rng(5)
    t = np.stack([0.01 * np.arange(12), 3 + 0.01 * np.arange(12), np.sort(rng.uniform(0, 0.1, 12))])
    basis = np.stack([np.linalg.qr(np.vander((row - row[0]) / 0.1, 4))[0] for row in t])
    values = rng.standard_normal((3, 12, 2))
    windows = Windows(t, basis, values - basis @ (basis.swapaxes(1, 2) @ values), np.full(3, 2))
    merged = windows.merged()
    assert sorted(merged.columns.tolist()) == [2, 4] and merged.count == windows.count
    noises = [CorrelatedNoise(0.9, 0.02, order=order) for order in FALLS]
    np.testing.assert_allclose(_likelihoods([merged], noises), _likelihoods([windows], noises), rtol=1e-12)


def likeliest(contrasts: FlightContrasts) -> CorrelatedNoise:
    start = [(-1.0, 0.0, np.log(0.02))]
    every = RestrictedLikelihood(contrasts, (0, 1))
    return max((_climbed(every, start, (), order) for order in FALLS), key=lambda one: one[1])[0]


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


def test_contrasts_count_what_states_and_common_effects_leave() -> None:
    one = contrasts_of(np.zeros((4, 10, 3)), torch.zeros(4, 10, 3, 5, dtype=F64))
    assert one.count == 4 * (30 - 6) - 5
    one.mask[0, 5:] = 0
    assert one.count == 4 * (30 - 6) - 5 - 15
