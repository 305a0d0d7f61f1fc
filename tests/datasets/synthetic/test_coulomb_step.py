"""Coulomb friction among several bodies in the steps of MuJoCo, by laws."""

import mujoco
import numpy as np
import pytest
from cgwm.datasets.synthetic.coulomb_step import ask_for_no_slip, coulomb_step

GRAVITY = 9.81
STEP_S = 1 / 3600


def prepared(bodies: str, pairs: dict[tuple[str, str], float]) -> tuple[mujoco.MjModel, mujoco.MjData]:
    contacts = "".join(
        f'<pair geom1="{a}" geom2="{b}" condim="3" friction="{mu} {mu} 0 0 0" solref="0.004 0.5" '
        'solimp="0.97 0.97 0.001"/>'
        for (a, b), mu in pairs.items()
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP_S}" gravity="0 0 {-GRAVITY}" cone="elliptic" impratio="1" tolerance="1e-10" '
        'iterations="50" integrator="implicitfast"/>'
        '<default><geom contype="0" conaffinity="0"/></default>'
        f'<worldbody><geom name="ground" type="plane" size="1 1 0.1"/>{bodies}</worldbody>'
        f"<contact>{contacts}</contact></mujoco>"
    )
    ask_for_no_slip(model)
    return model, mujoco.MjData(model)


def body(name: str, height_m: float, form: str, mass_kg: float) -> str:
    geom = f'<geom name="{name}" {form} mass="{mass_kg}"/>'
    return f'<body name="{name}" pos="0 0 {height_m}"><freejoint/>{geom}</body>'


@pytest.mark.parametrize("under", [0.1, 0.02])
def test_a_block_that_slides_on_another_one_is_slowed_and_drags_it_along(under: float) -> None:
    low = body("low", 0.02, 'type="box" size="0.3 0.2 0.02"', 2.0)
    top = body("top", 0.06, 'type="box" size="0.05 0.04 0.02"', 0.5)
    model, data = prepared(low + top, {("low", "ground"): under, ("low", "top"): 0.4})
    data.qvel[6] = 1.0
    speeds, heights = [], []
    for _ in range(360):
        coulomb_step(model, data)
        speeds.append(data.qvel[[0, 6]].copy())
        heights.append(data.qpos[9])
    rates = np.polyfit(STEP_S * np.arange(180), np.array(speeds)[180:], 1)[0]  # the load has come to rest by then
    dragged = max(0.0, (0.4 * 0.5 - under * 2.5) * GRAVITY / 2.0)
    assert rates == pytest.approx([dragged, -0.4 * GRAVITY], rel=2e-3, abs=1e-3)
    assert np.ptp(heights) < 5e-5


@pytest.mark.parametrize("speed", [3.0, 0.5])
def test_a_ball_that_hits_the_ground_gets_the_friction_of_its_impact_or_rolls(speed: float) -> None:
    model, data = prepared(body("ball", 0.06, 'type="sphere" size="0.05"', 0.3), {("ball", "ground"): 0.3})
    data.qvel[:3] = speed, 0.0, -1.5
    pressed = 0.0
    while not pressed or data.ncon:
        coulomb_step(model, data)
        pressed += data.efc_force[0] * STEP_S if data.nefc else 0.0
    slip, slides_on = data.qvel[0] - 0.05 * data.qvel[4], speed - 3.5 * 0.3 * pressed / 0.3
    if slides_on > 0:  # each N s of friction takes 7/2 of its share by the mass off the slip
        assert 0.3 * (speed - data.qvel[0]) == pytest.approx(0.3 * pressed, rel=1e-6)
        assert slip == pytest.approx(slides_on, rel=0.03)  # pressed in, its radius is shorter by some percent
    else:
        assert abs(slip) < 0.02 * speed
        assert data.qvel[0] == pytest.approx(5 / 7 * speed, rel=0.02)
