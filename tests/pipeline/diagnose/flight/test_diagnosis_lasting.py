"""Errors that last from frame to frame: they are told, and are not taken for something that is missing."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.diagnose.verdict import find
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.segments.prepare import LIMITS, Prepared, _reach, _smeared, prepare
from cgwm.pipeline.trajectories.correlated_noise import estimate_noise_model
from cgwm.pipeline.trajectories.innovations import WHITE, CorrelatedNoise, NoiseModel, innovations  # pyright: ignore[reportMissingImports]
from helpers.diagnosis_data import NOISE, tosses, world_with
from scipy.signal import butter, filtfilt, savgol_filter

LIBRARY = [
    Candidate(name, load_effect(name))
    for name in (
        "linear_drag", "quadratic_drag", "magnus_lift", "constant_force", "gravity_tilt", "com_offset",
        "rolling_resistance", "stribeck_friction", "velocity_restitution", "adhesion", "clock_scale",
    )
]  # fmt: skip
Episodes = list[tuple[str, dict[str, Track]]]


def lasting(rho: float, seed: int) -> Callable[[Track], Track]:
    """Add errors of which the next frame has a share left."""
    rng = np.random.default_rng(seed)

    def change(track: Track) -> Track:
        errors = rng.standard_normal((len(track.time_s), 6))
        for k in range(1, len(errors)):
            errors[k] = rho * errors[k - 1] + np.sqrt(1 - rho**2) * errors[k]
        turn = quat_exp(torch.as_tensor(NOISE[1] * errors[:, 3:]))
        quat = quat_multiply(torch.as_tensor(track.quat_wxyz), turn).numpy()
        return replace(track, position_m=track.position_m + NOISE[0] * errors[:, :3], quat_wxyz=quat)

    return change


def smoothed(track: Track) -> Track:
    quat = np.array(track.quat_wxyz)
    quat[1:] *= np.cumprod(np.sign((quat[1:] * quat[:-1]).sum(1)))[:, None]
    quat = savgol_filter(quat, 7, 2, axis=0)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return replace(track, position_m=savgol_filter(track.position_m, 7, 2, axis=0), quat_wxyz=quat)


def low_passed(track: Track) -> Track:
    low: Any = butter(2, 15.0, fs=100.0)
    return replace(track, position_m=filtfilt(*low, track.position_m, axis=0), quat_wxyz=None)


def changed(episodes: Episodes, change: Callable[[Track], Track]) -> Episodes:
    return [(name, {body: change(track) for body, track in tracks.items()}) for name, tracks in episodes]


def ready(body: str, effects: dict, change: Callable[[Track], Track] | None, seed: int = 1) -> tuple[Prepared, object]:
    noise = NOISE if change in (None, smoothed, low_passed) else (1e-9, 1e-8)
    episodes = tosses(world_with(body, effects), seed, count=6, duration_s=0.8, noise=noise, height_m=(0.4, 0.7))
    world = world_with(body)
    return prepare(world, episodes if change is None else changed(episodes, change)), world


@cache
def tossed_ball(change: Callable[[Track], Track] | None) -> tuple[Prepared, object]:
    """Return tosses of a ball in which nothing is missing, as `ready` has them; several tests look at them."""
    return ready("ball", {}, change)


def test_innovations_are_what_the_inverse_of_the_covariance_says() -> None:
    rng = np.random.default_rng(0)
    times = torch.as_tensor(np.sort(rng.uniform(0, 0.3, (2, 12)).round(9), axis=1))  # times closer than 1 ns are one
    mask = torch.ones(2, 12, dtype=torch.float64)
    mask[0, [3, 4, 9]] = 0  # not measured, a gap among them
    rows = torch.as_tensor(rng.standard_normal((2, 12, 5))) * mask[..., None]
    for share in (1.0, 0.6):
        found = innovations(rows, times, mask, CorrelatedNoise(share, 0.05, 2.0))
        for k in range(2):
            kept = mask[k] > 0
            t = times[k, kept]
            covariance = share * torch.exp(-(t[:, None] - t).abs() / 0.05) + (1 - share) * torch.eye(len(t)).double()
            known = torch.linalg.solve_triangular(torch.linalg.cholesky(4 * covariance), rows[k, kept], upper=False)
            torch.testing.assert_close(found[k, kept], known, rtol=1e-8, atol=1e-10)
        assert not found[mask == 0].any()


@pytest.mark.parametrize("body", ["cube", "ball"])
def test_errors_that_last_are_measured(body: str) -> None:
    prepared, _ = ready(body, {}, lasting(0.7, 3))
    for one, std, true in zip(prepared.noise_model, prepared.noise, NOISE, strict=True):
        # what is new in each frame is told well; how much lasts is not, and rather too much of it is taken
        kept = np.exp(-0.01 / one.time_s)
        fresh = (one.size * std / true) ** 2 * (1 - one.share * kept**2)
        assert kept >= 0.6 and one.share > 0.5 and fresh == pytest.approx(1 - 0.7**2, rel=0.25)
        assert 0.7 < std / true < 3
    assert any("are correlated in time" in warning for warning in prepared.warnings)


@pytest.mark.parametrize(
    ("body", "effects"),
    [("ball", {}), ("cube", {"com_offset": {"d_x": 0.008}}), ("ball", {"ground_magnet": {"A": 12.0}})],
)
def test_errors_that_do_not_last_are_not_taken_for_such(body: str, effects: dict) -> None:
    prepared, _ = ready(body, effects, None) if effects else tossed_ball(None)
    assert prepared.noise_model == WHITE
    assert prepared.flight is not None and prepared.flight.noise_model == WHITE


def test_rounding_does_not_last() -> None:
    world = world_with("ball", {"linear_drag": {"c": 0.3}})
    exact = tosses(world, 1, count=4, duration_s=0.5, noise=(1e-14, 1e-14))
    prepared = prepare(world_with("ball"), exact, NOISE)
    assert prepared.noise_model == WHITE and prepared.noise == NOISE


@pytest.mark.parametrize("body", ["ball", "box"])
def test_an_orientation_that_never_changes_tells_nothing_of_noise(body: str) -> None:
    unturned = [
        (
            name,
            {key: replace(track, quat_wxyz=np.tile([1.0, 0, 0, 0], (len(track), 1))) for key, track in own.items()},
        )
        for name, own in tosses(world_with(body), 1, count=4, duration_s=0.5)
    ]
    prepared = prepare(world_with(body), unturned, NOISE)
    assert prepared.noise_model == WHITE and prepared.noise == NOISE


def test_few_frames_tell_nothing() -> None:
    prepared, _ = ready("ball", {}, lasting(0.9, 3))
    assert estimate_noise_model(prepared.observations, [prepared.flight.items[0]], NOISE) == (WHITE, (None, None))  # pyright: ignore
    assert estimate_noise_model(prepared.observations, [], NOISE) == (WHITE, (None, None))


EACH = [pytest.param(lasting(0.8, 5), id="lasting", marks=pytest.mark.evidence), pytest.param(smoothed, id="smoothed")]


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("change", "verdict"),
    # a filter smears impacts, which no contact law describes then
    [(lasting(0.8, 5), "none_missing"), (smoothed, "law_inexact")],
    ids=["lasting", "smoothed"],
)
def test_they_are_no_effect(change: Callable[[Track], Track], verdict: str) -> None:
    prepared, world = ready("ball", {}, change)
    found = find(prepared, world, LIBRARY)  # pyright: ignore[reportArgumentType]
    assert found.verdict == verdict and not found.chosen


@pytest.mark.parametrize("change", EACH)
def test_they_are_in_the_segments_of_flights(change: Callable[[Track], Track]) -> None:
    prepared, world = tossed_ball(change)
    assert prepared.noise_model != WHITE
    blind = replace(prepared, noise_model=NoiseModel())
    assert prepared.flight is not None
    items = prepared.flight.items
    slow = [p.segments("flight", world, items) for p in (prepared, blind)]  # pyright: ignore[reportArgumentType]
    assert slow[0].noise_model != WHITE and slow[1].noise_model == WHITE


# In the suite: that errors are measured and reach the segments is tested above.
@pytest.mark.evidence
@pytest.mark.parametrize("change", [lasting(0.8, 5), smoothed], ids=["lasting", "smoothed"])
def test_they_hide_no_effect(change: Callable[[Track], Track]) -> None:
    prepared, world = ready("ball", {"linear_drag": {"c": 0.6}}, change)
    found = find(prepared, world, LIBRARY)  # pyright: ignore[reportArgumentType]
    assert [one.evidence.name for one in found.chosen] == ["linear_drag"]


def test_frames_beside_a_smoothed_contact_are_no_flight() -> None:
    sharp, _ = tossed_ball(None)
    smeared, _ = tossed_ball(smoothed)
    seen = sharp.observations.seen.amax(-1) > 0
    for episode in range(len(sharp.names)):
        contact = np.flatnonzero((~sharp.airborne & seen)[episode].numpy())
        near = {int(k) + d for k in contact for d in range(-LIMITS.smeared_frames, LIMITS.smeared_frames + 1)}
        flies = set(np.flatnonzero(smeared.airborne[episode].numpy()).tolist())
        # what smoothing lifts above the ground may move the contact by a frame
        assert len(flies & near) <= 2 * max(1, len(contact))
        assert contact.size == 0 or len(flies) < int(sharp.airborne[episode].sum())


@pytest.mark.parametrize(("share", "reach"), [(0.99, 5), (0.9, 3)])
def test_errors_with_a_white_part_come_from_no_filter_which_would_smear_contacts(share: float, reach: int) -> None:
    sharp, _ = tossed_ball(None)
    contact = torch.zeros_like(sharp.airborne)
    contact[0, 10] = True
    errors = NoiseModel(CorrelatedNoise(share, 0.06, order=2.5), CorrelatedNoise())
    smeared = _smeared(sharp.observations, contact, _reach(sharp.observations, errors))
    near = torch.nonzero(smeared[0])[:, 0].tolist()
    assert near == list(range(10 - reach, 10 + reach + 1))


def test_what_a_low_pass_bends_is_no_noise() -> None:
    """It bends contacts by centimetres, and the begin of a record by a millimetre."""
    prepared, _ = tossed_ball(low_passed)
    assert prepared.noise.position_m < NOISE[0]
    seen = prepared.observations.seen.amax(-1) > 0
    assert not bool(seen[:, :3].any()) and prepared.flight is not None


def test_smeared_contacts_may_leave_no_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cgwm.pipeline.segments.prepare.LIMITS", replace(LIMITS, smeared_frames=200))
    prepared, _ = ready("ball", {}, lasting(0.8, 5))
    assert prepared.noise_model != WHITE and prepared.least_force_m_s2 > 0
    touched = {item.episode for item in prepared.contact_items}
    assert prepared.flight is None or not touched & {item.episode for item in prepared.flight.items}


def test_a_box_without_orientation_has_no_contact_though_errors_last() -> None:
    change = lasting(0.8, 5)
    prepared, _ = ready("cube", {}, lambda track: replace(change(track), quat_wxyz=None))
    assert prepared.noise_model != WHITE and not prepared.has_orientation
    assert prepared.contact_items == ()
