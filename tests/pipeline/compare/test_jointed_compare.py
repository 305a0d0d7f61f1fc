"""Short predictions of jointed bodies: tracks of their own simulation are within the noise, those of others are not."""

from dataclasses import replace

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.models.model import Model
from cgwm.pipeline.compare.residual_wrenches import wrench_points
from cgwm.pipeline.compare.short_horizon_errors import short_errors
from cgwm.pipeline.physics import State, World, simulate, world_of_model
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.segments.prepare import prepare
from cgwm.schemas import PHASES
from helpers.jointed_model import jointed_model
from helpers.worlds import F64

NOISE = (1e-4, 1e-3)


def thrown(world: World) -> Episode:
    """Return noisy tracks of the links of a throw of 0.07 s, during which the hinge turns fast."""
    zero = torch.zeros(1, 2, 3, dtype=F64)
    turn = torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(1, 2, 4)
    place = zero + torch.tensor([0.0, 0.0, 0.5], dtype=F64)
    state = with_joints(world, State(place, turn, zero, zero.clone()), {"elbow": 0.4}, {"elbow": 25.0})
    times = torch.arange(11, dtype=F64) / 150
    motion, rng = simulate(world, state, times), np.random.default_rng(0)
    tracks = {}
    for k, name in enumerate(world.body_names):
        spin = np.c_[np.ones(11), 0.5 * NOISE[1] * rng.standard_normal((11, 3))]
        quats = _times(motion.quat_wxyz[0, :, k].numpy(), spin)
        tracks[name] = Track(
            times.numpy(), motion.position_m[0, :, k].numpy() + NOISE[0] * rng.standard_normal((11, 3)), quats
        )
    return Episode("toss", tracks)


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return normalised products of quaternions (T, 4)."""
    w = a[:, 0] * b[:, 0] - (a[:, 1:] * b[:, 1:]).sum(1)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    quats = np.c_[w, v]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def heavier(model: Model) -> World:
    """Return the world of the model with a second link of three times the mass and inertia."""
    world = world_of_model(model)
    upper, lower = world.bodies
    return replace(world, bodies=(upper, replace(lower, mass=3 * lower.mass, inertia=3 * lower.inertia)))


def test_a_throw_is_within_the_noise_of_its_own_world_and_not_of_one_with_other_masses() -> None:
    model = jointed_model()
    world = world_of_model(model)
    episodes = [thrown(world)]
    prepared = prepare(world, episodes, NOISE)
    assert prepared.flight is not None and not prepared.contact_items
    own, other = (short_errors(each, episodes, prepared, world.body_names) for each in (world, heavier(model)))
    errors = [fit.errors["toss"] for fit in (own, other)]
    chi2 = [float(np.nansum(np.square(one.sigmas)) / one.freedom.sum()) for one in errors]
    assert 0.7 < chi2[0] < 1.4 and chi2[1] > 5
    # 12 coordinates of the root and two of the hinge were fitted to 2 links, 11 frames and 6 coordinates
    assert abs(own.errors["toss"].freedom.sum() - (2 * 11 * 6 - 14)) < 1.0
    assert set(own.errors["toss"].phase) == {PHASES.index("flight")}
    assert wrench_points(world, own, prepared) == ([], [])
