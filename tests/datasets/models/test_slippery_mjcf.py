"""MJCF of slippery bodies: MuJoCo's impacts with slip follow Coulomb's law."""

import mujoco
import numpy as np
import pytest
from cgwm.datasets.models.mjcf import APART, SLIPPERY, write_mjcf
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from helpers.small_model import small_model

RADIUS_M, FALL_M_S = 0.04, 2.0


def _ball(friction: float) -> "mujoco.MjModel":
    plain = small_model()
    body = plain.file.bodies[0]
    law = plain.file.contact.model_copy(update={"friction": friction, "contact_time_s": 0.006, "damping_ratio": 0.3})
    spheres = Splats(np.zeros((1, 3)), np.full(1, RADIUS_M / 2), np.full(1, 0.9), np.full((1, 3), 0.5))
    file = plain.file.model_copy(update={"contact": law, "parameters": ()})
    return mujoco.MjModel.from_xml_string(
        write_mjcf(Model(**vars(plain) | {"file": file, "collision": {body.name: spheres}}))
    )


def _change_m_s(loaded: "mujoco.MjModel", sideways_m_s: float) -> np.ndarray:
    """Return how an impact changes the velocity of the ball (3,)."""
    loaded.opt.gravity[:] = 0
    data = mujoco.MjData(loaded)
    data.qpos[:3] = 0, 0, RADIUS_M + 0.01
    data.qvel[:3] = sideways_m_s, 0, -FALL_M_S
    before = data.qvel[:3].copy()
    mujoco.mj_step(loaded, data, round(0.04 / loaded.opt.timestep))
    return data.qvel[:3] - before


@pytest.mark.parametrize("friction", [0.1, 0.2, 0.3])
def test_slip_does_not_lift_a_slippery_body(friction: float) -> None:
    loaded = _ball(friction)
    assert loaded.opt.impratio == pytest.approx(APART) and loaded.opt.noslip_iterations > 0
    straight, sliding = _change_m_s(loaded, 0.0), _change_m_s(loaded, 6.0)
    assert straight[2] > 1.2 * FALL_M_S
    assert sliding[2] == pytest.approx(straight[2], rel=0.01)
    assert -sliding[0] == pytest.approx(friction * sliding[2], rel=0.03)  # Coulomb's law through the whole impact


def test_others_have_their_forces_found_together() -> None:
    loaded = _ball(SLIPPERY + 0.01)
    assert loaded.opt.impratio == 1 and loaded.opt.noslip_iterations == 0
    assert _change_m_s(loaded, 6.0)[2] > 1.1 * _change_m_s(loaded, 0.0)[2]  # what the page on exports says of it
