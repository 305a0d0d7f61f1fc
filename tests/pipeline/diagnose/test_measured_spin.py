"""The spin of a ball without orientations, measured once for each throw, tells its lift from other sideways forces."""

from dataclasses import replace

import numpy as np
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.diagnose.stage import library_of
from cgwm.pipeline.diagnose.verdict import find
from cgwm.pipeline.phys_geo.effects.effect_fit import fit_effects
from cgwm.pipeline.segments.candidates import admissible
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.diagnosis_data import tosses, world_with
from scipy.spatial.transform import Rotation

LIFT, SPIN_STD_RAD_S, NOISE = 0.01, 0.3, Noise(2e-4, 1e-2)


def throws(measured: bool = True) -> list[Episode]:
    """Flights of a ball with lift: its centroid, and a spin along the world's axes with one error for each throw."""
    rng = np.random.default_rng(5)
    episodes = []
    flights = tosses(world_with("ball", {"magnus_lift": {"s": LIFT}}), 3, 6, 0.4, 100.0, (2e-4, 1e-6), (1.5, 2.0))
    for name, tracks in flights:
        turned = Rotation.from_quat(tracks["ball"].quat_wxyz, scalar_first=True)
        spin = 100.0 * (turned[1:] * turned[:-1].inv()).as_rotvec().mean(0) + SPIN_STD_RAD_S * rng.standard_normal(3)
        spins = np.tile(spin, (len(turned), 1)) if measured else None
        episodes.append(Episode(name, {"ball": replace(tracks["ball"], quat_wxyz=None, omega_body_rad_s=spins)}))
    return episodes


def test_magnus_lift_is_named_and_fitted_from_measured_spins() -> None:
    world = world_with("ball")
    prepared = prepare(world, throws(), NOISE)
    found = find(prepared, world, library_of(()))
    assert found.verdict == "missing_effect" and found.ranking[0].name == "magnus_lift"
    assert prepared.flight is not None
    at_start, spins = prepared.flight.observations.state.omega_body_rad_s[:, 0], prepared.flight.observations.first_spin
    assert spins is not None and bool(((at_start - spins[0][:, 0]).norm(dim=-1) < 3 * SPIN_STD_RAD_S).all())
    fitted = fit_effects(world_with("ball", {"magnus_lift": {}}), throws(), [], NOISE)
    low, high = fitted.parameters[0].interval_95 or (0, 0)
    assert low < LIFT < high < 1.5 * LIFT


def test_a_spin_without_orientations_admits_lift_and_no_centre_of_mass() -> None:
    world, candidates = world_with("ball"), library_of(())
    kept = {one.effect.name for one in admissible(world, candidates, turned=False, spun=True)[0]}
    refused = admissible(world, candidates, turned=False)[1]
    assert "magnus_lift" in kept and not kept & {"com_offset", "spin_damping", "marker_offset"}
    assert refused["magnus_lift"] == "no orientation and no spin was measured"
    assert prepare(world, throws(measured=False), NOISE).observations.first_spin is None
