"""Jointed bodies: their centre of mass falls freely whatever the joints do, and shows what acts on the whole."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.models.model import Model
from cgwm.pipeline.diagnose.stage import library_of, report
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply, quat_rotate
from cgwm.pipeline.physics import State, World, engine, world_of_model
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.segments.center_of_mass import as_one_body
from cgwm.pipeline.segments.prepare import prepare
from cgwm.schemas import InputDataError
from helpers.jointed_model import jointed_model
from helpers.worlds import F64

COUNT, FRAMES = 4, 38


def throws(world: World, noise: tuple[float, float] = (0.0, 0.0)) -> list[Episode]:
    """Return tracks of the links of throws, in which the hinge turns fast, until they are below the ground."""
    rng = np.random.default_rng(0)
    draws = torch.as_tensor(rng.normal(size=(COUNT, 2, 3)))
    zero = torch.zeros(COUNT, 2, 3, dtype=F64)
    turn = torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(COUNT, 2, 4)
    place, speed = zero + torch.tensor([0.0, 0.0, 0.3], dtype=F64), zero + torch.tensor([0.0, 0.0, 1.5], dtype=F64)
    spins = 4 * draws[:, :1].expand(-1, 2, -1)
    state = State(place, turn, speed + 0.5 * draws[:, 1:], spins)
    state = with_joints(world, state, {"elbow": 0.4}, {"elbow": 8 * draws[:, 0, 0]})
    times = torch.arange(FRAMES, dtype=F64) / 60
    motion = engine.rollout(replace(world, touching=False, step_s=0.005), state, times)
    shifts, turns = (std * torch.as_tensor(rng.normal(size=(COUNT, FRAMES, 2, 3))) for std in noise)
    position, quat = motion.position_m + shifts, quat_multiply(motion.quat_wxyz, quat_exp(turns))
    return [
        Episode(
            str(k),
            {
                name: Track(times.numpy(), position[k, :, body].numpy(), quat[k, :, body].numpy())
                for body, name in enumerate(world.body_names)
            },
        )
        for k in range(COUNT)
    ]


def test_the_centre_of_mass_falls_freely_until_a_link_touches_the_ground() -> None:
    world = world_of_model(jointed_model())
    alone, flown = as_one_body(world, throws(world), (1e-4, 1e-3), "here")
    assert [body.name for body in alone.bodies] == ["arm"] and float(alone.bodies[0].mass) == pytest.approx(0.5)
    for _, tracks in flown:
        track = tracks["arm"]
        fall = track.position_m - 0.5 * np.outer(track.time_s**2, world.gravity[0].numpy())
        line = np.vander(track.time_s, 2)
        assert track.quat_wxyz is None and 15 < len(track) < FRAMES
        assert np.abs(fall - line @ np.linalg.lstsq(line, fall, rcond=None)[0]).max() < 5e-4  # a step of 5 ms


@pytest.mark.parametrize("tilt_rad", [pytest.param(0.0, marks=pytest.mark.evidence), 0.03])
def test_a_diagnosis_of_the_whole_names_a_tilt_of_gravity_and_nothing_where_there_is_none(tilt_rad: float) -> None:
    world = world_of_model(jointed_model())
    gravity = quat_rotate(quat_exp(torch.tensor([[0.0, tilt_rad, 0.0]], dtype=F64)), world.gravity)
    episodes = throws(replace(world, gravity=gravity), (3e-4, 3e-3))
    alone, flown = as_one_body(world, episodes, (None, None), "here")
    library = [one for one in library_of(()) if one.spec in ("gravity_tilt", "linear_drag")]
    result = report(prepare(alone, flown), alone, library)
    assert result.verdict == ("missing_effect" if tilt_rad else "none_missing")
    if tilt_rad:
        found = {p.name: p for p in result.ranking[0].parameters}
        assert result.selected == ("gravity_tilt",)
        assert abs(found["tilt_y"].estimate - tilt_rad) < 4 * found["tilt_y"].std_error < 0.01


def refused(model: Model) -> None:
    world = world_of_model(model)
    with pytest.raises(InputDataError, match=r"here: what moves is 'arm' \(\w+ root\)"):
        as_one_body(world, [], (None, None), "here")


def test_a_fixed_root_and_another_free_body_are_refused() -> None:
    refused(jointed_model(base="fixed"))
    refused(jointed_model(cube=True))
