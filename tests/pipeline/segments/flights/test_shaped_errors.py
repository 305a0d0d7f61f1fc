"""Intervals of effects beside errors of tracks that no model of the noise has."""

import numpy as np
import pytest
import torch
from cgwm.pipeline.segments.flights.shaped_errors import no_narrower
from torch import Tensor

FLIGHTS, FRAMES, PARAMETERS = 6, 50, 2
PRIOR = np.eye(PARAMETERS) * 1e-6


def _slopes(rng: np.random.Generator) -> Tensor:
    """Derivatives by a force that lasts in each flight, by one that swings, and by positions and velocities."""
    t = np.linspace(0, 1, FRAMES)
    found = np.zeros((FLIGHTS, FRAMES, 6, PARAMETERS + 6))
    for flight in range(FLIGHTS):
        courses = t**2, np.sin(9 * t + rng.uniform(0, 6))
        for k, course in enumerate(courses):
            found[flight, :, :3, k] = 20 * course[:, None] * rng.standard_normal(3)
        for axis in range(3):
            found[flight, :, axis, PARAMETERS + axis] = 1.0
            found[flight, :, axis, PARAMETERS + 3 + axis] = t
    return torch.from_numpy(found)


def _errors(rng: np.random.Generator, kept: float) -> Tensor:
    """Errors (B, F, 6) of positions of variance 1, of which a share is kept from frame to frame."""
    found = np.zeros((FLIGHTS, FRAMES, 6))
    state = rng.standard_normal((FLIGHTS, 3))
    for frame in range(FRAMES):
        found[:, frame, :3] = state
        state = kept * state + np.sqrt(1 - kept**2) * rng.standard_normal(state.shape)
    return torch.from_numpy(found)


def _fitted(rows: Tensor, slopes: Tensor) -> tuple[np.ndarray, np.ndarray, Tensor]:
    """Return estimates (P,), their covariance for white noise, and what the fit leaves."""
    states = torch.linalg.qr(slopes[..., PARAMETERS:].flatten(1, 2))[0]
    flat = slopes[..., :PARAMETERS].flatten(1, 2)
    flat = flat - states @ (states.mT @ flat)
    covariance = torch.linalg.inv((flat.mT @ flat).sum(0))
    found = covariance @ (flat.mT @ rows.flatten(1, 2)[..., None]).sum(0)[:, 0]
    return found.numpy(), covariance.numpy(), rows - slopes[..., :PARAMETERS] @ found


@pytest.mark.parametrize(("kept", "least", "most"), [(0.0, 0.91, 0.995), (0.9, 0.88, 1.0)])
def test_intervals_hold_where_errors_last(kept: float, least: float, most: float) -> None:
    """A model of white noise is right, or errors last for ten frames: with the errors' shape intervals hold in both."""
    rng, plain, held = np.random.default_rng(3), [], []
    for _ in range(40):
        slopes = _slopes(rng)
        found, covariance, left = _fitted(_errors(rng, kept), slopes)
        wider = no_narrower(covariance, left, slopes, PRIOR)
        plain += (np.abs(found) < 1.96 * np.sqrt(np.diag(covariance))).tolist()
        held += (np.abs(found) < 1.96 * np.sqrt(np.diag(wider))).tolist()
        assert (np.diag(wider) >= np.diag(covariance)).all()
    assert least <= np.mean(held) <= most
    assert np.mean(plain) < 0.7 or not kept


def test_axes_that_nobody_measured_count_for_nothing() -> None:
    """Of a motion seen from above alone, the third axis has no residuals, which are no sign of small errors."""
    rng = np.random.default_rng(5)
    slopes, rows = _slopes(rng), _errors(rng, 0.9)
    slopes[:, :, 2], rows[:, :, 2] = 0.0, 0.0
    _, covariance, left = _fitted(rows, slopes)
    seen = no_narrower(covariance, left, slopes, PRIOR)
    assert np.allclose(
        seen, no_narrower(covariance, left[:, :, [2, 0, 1, 3, 4, 5]], slopes[:, :, [2, 0, 1, 3, 4, 5]], PRIOR)
    )
    assert np.sqrt(seen[0, 0] / covariance[0, 0]) > 1.5
