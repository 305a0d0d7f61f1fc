"""Walls that a body could pass: the predicted speeds are those at which it does, and what is refused or warned of."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.pipeline.physics import World
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.surfaces.fixed_surface import FixedSurface
from cgwm.pipeline.physics.surfaces.thin_walls import _SAID, require_thick_walls, thin_wall_warnings, walls
from cgwm.schemas import InputDataError
from helpers import fixed_surfaces as fixed
from helpers import worlds
from helpers.worlds import ball_body, state_of, times

R, TIME = 0.01, 0.01


def scene(surface: FixedSurface, ratio: float = 0.4, step_s: float = 0.001) -> World:
    world = worlds.world_of(ball_body(R), ground=False, step_s=step_s)
    return replace(world, contact=worlds.law(0.3, TIME, ratio), surfaces=(surface,), gravity=0 * world.gravity)


WALLS = {
    "sheet": fixed.box((0.3, 0.3, 0), "wall"),
    "board": fixed.box((0.3, 0.3, 0.004), "wall"),
    "closed mesh": fixed.mesh_surface(*fixed.box_mesh((0.05, 0.05, 0.004), 4), solid=True, name="wall"),
}


@pytest.mark.parametrize("name", WALLS)
@pytest.mark.parametrize("ratio", [0.1, 0.7, 1.5])
def test_an_impact_passes_from_the_predicted_speed_on(name: str, ratio: float) -> None:
    world = scene(WALLS[name], ratio)
    (wall,) = walls(world)
    assert wall.depth_m == pytest.approx(R + (0.0 if name == "sheet" else 0.004))
    for share, passes in ((0.9, False), (1.1, True)):
        speed = share * wall.impact_m_s
        state = state_of(((0.003, 0.002, 0.03), (1, 0, 0, 0), (0, 0, -speed), (0, 0, 0)))
        with torch.no_grad():
            end = float(rollout(world, state, times(0.2, 20)).position_m[0, -1, 0, 2])
        assert (end < 0) == passes, (share, end)


def test_what_jumps_over_a_wall_is_refused_and_what_may_fall_through_is_said(caplog: pytest.LogCaptureFixture) -> None:
    world = scene(WALLS["board"], step_s=0.002)
    fast = state_of(((0, 0, 0.03), (1, 0, 0, 0), (0, 0, -8), (0, 0, 0)))
    with pytest.raises(InputDataError) as caught:
        require_thick_walls(world, fast, "rollout 3")
    assert str(caught.value).startswith(
        "rollout 3: body 'ball' begins at 8 m/s, 16 mm in a step: it can jump over surface 'wall', whose middle its "
        "smallest sphere reaches 14 mm deep."
    )
    assert "up to 7 m/s" in str(caught.value)
    _SAID.clear()
    falls = replace(world, gravity=torch.tensor([[0.0, 0.0, -9.81]], dtype=torch.float64))
    (wall,) = walls(falls)
    height = wall.impact_m_s**2 / (2 * 9.81) - 0.004
    with caplog.at_level(logging.WARNING, "cgwm"):
        require_thick_walls(falls, state_of(((0, 0, 0.98 * height), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))))
        assert not caplog.records
        require_thick_walls(falls, state_of(((0, 0, 1.02 * height), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))))
        require_thick_walls(falls, state_of(((0, 0, 2 * height), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))))
    assert len(caplog.records) == 1
    speed = math.sqrt(2 * 9.81 * (1.02 * height + 0.004))
    assert f"may reach {speed:.3g} m/s, and from {wall.impact_m_s:.3g} m/s on" in caplog.text


def test_a_soft_contact_with_a_sheet_is_said_at_load() -> None:
    world = replace(scene(WALLS["sheet"]), gravity=torch.tensor([[0.0, 0.0, -9.81]], dtype=torch.float64))
    assert thin_wall_warnings(world) == []
    soft = replace(world, contact=worlds.law(0.3, 0.04, 0.4))
    (text,) = thin_wall_warnings(soft)
    assert text.startswith("a fall of body 'ball' by its own diameter (0.626 m/s) takes it through surface 'wall'")
    assert list(walls(scene(fixed.half_space()))) == []


def test_a_height_field_has_no_far_side_but_contacts_end_below_its_cells() -> None:
    x, y = np.meshgrid(np.arange(3.0), np.arange(3.0), indexing="ij")
    vertices = np.stack((x, y, 0 * x), -1).reshape(-1, 3) * 0.05
    faces = [(a, a + 3, a + 4) for a in (0, 1, 3, 4)] + [(a, a + 4, a + 1) for a in (0, 1, 3, 4)]
    (wall,) = walls(scene(fixed.mesh_surface(vertices, faces, solid=True, name="wall")))
    assert wall.depth_m == pytest.approx(R + 0.05)
