"""Contact laws of pairs of materials against closed forms."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.physics import Body, PaperLaw, restitution
from cgwm.pipeline.physics.checks import largest_step, require_physical
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.pair_laws import laws_in_use
from cgwm.schemas import InputDataError, UsageError
from helpers.worlds import ball_body, batch, box_body, law, state_of, times, world_of

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
G = 9.81
REST_M = 1.4e-4
FLAT = (0.05, 0.05, 0.004)


def brick(name: str, material: str | None) -> Body:
    return replace(box_body(half=FLAT), name=name, material=material)


def test_two_bodies_on_one_ground_slide_their_own_distances() -> None:
    """v^2 / (2 mu g), of flat boxes, which do not tip; 0.5 %."""
    slow, speed = (0.2, 0.5), 1.0
    world = world_of(brick("smooth", "ice"), brick("rough", "rubber"))
    world = replace(
        world, ground_material="wood", pair_laws={("ice", "wood"): law(slow[0]), ("rubber", "wood"): law(slow[1])}
    )
    state = state_of(
        ((0, 0, FLAT[2] - REST_M), UPRIGHT, (speed, 0, 0), (0, 0, 0)),
        ((0, 1, FLAT[2] - REST_M), UPRIGHT, (speed, 0, 0), (0, 0, 0)),
    )
    moved = rollout(world, state, times(0.7)).position_m[0, -1, :, 0]
    expected = torch.tensor([speed**2 / (2 * mu * G) for mu in slow], dtype=moved.dtype)
    torch.testing.assert_close(moved, expected, rtol=5e-3, atol=0)


def test_friction_of_each_pair_on_a_slope() -> None:
    """g (sin - mu cos) of the body that slides, 0.5 %; the other one is held."""
    angle = torch.tensor(0.3, dtype=torch.float64)  # tan = 0.309
    world = world_of(brick("smooth", "ice"), brick("rough", "rubber"))
    world = replace(
        world, ground_material="wood", pair_laws={("ice", "wood"): law(0.2), ("rubber", "wood"): law(0.4)},
        gravity=G * torch.stack((angle.sin(), 0 * angle, -angle.cos()))[None],
    )  # fmt: skip
    rest = ((0, 0, FLAT[2] - REST_M), UPRIGHT, (0, 0, 0), (0, 0, 0))
    state = state_of(rest, ((0, 1, FLAT[2] - REST_M), UPRIGHT, (0, 0, 0), (0, 0, 0)))
    moved = rollout(world, state, times(0.5)).velocity_m_s[0, -1, :, 0]
    expected = G * 0.5 * (angle.sin() - 0.2 * angle.cos())
    torch.testing.assert_close(moved[0], expected, rtol=5e-3, atol=0)
    assert abs(float(moved[1])) < 1e-3 * float(expected)


def test_bodies_that_meet_have_the_friction_and_the_rebound_of_their_pair() -> None:
    """A spinning ball meets one at rest: the tangential impulse is mu times the normal one, the rebound e(zeta)."""
    speed, friction, ratio = 1.0, 0.2, 0.5
    first = replace(ball_body(name="first"), material="ice")
    second = replace(ball_body(name="second"), material="rubber")
    world = world_of(first, second, ground=False, gravity=0.0, step_s=3e-5, contact=law(0.9, 5e-4, 0.05))
    world = replace(world, pair_laws={("ice", "rubber"): law(friction, 5e-4, ratio)})
    state = state_of(
        ((0, 0, 0), UPRIGHT, (speed, 0, 0), (0, 0, 200.0)), ((0.0805, 0, 0), UPRIGHT, (0, 0, 0), (0, 0, 0))
    )
    velocity = rollout(world, state, times(0.01)).velocity_m_s[0, -1]
    torch.testing.assert_close(velocity[1, 1] / velocity[1, 0], torch.tensor(friction).to(velocity), rtol=5e-3, atol=0)
    rebound = (velocity[1, 0] - velocity[0, 0]) / speed
    torch.testing.assert_close(rebound, restitution(batch(ratio))[0], rtol=0.02, atol=0)


def test_a_pair_without_a_law_has_that_of_all_others() -> None:
    world = replace(
        world_of(brick("a", "ice"), brick("b", None), brick("c", "wood")),
        ground_material="wood", pair_laws={("ice", "wood"): law(0.1)},
    )  # fmt: skip
    used = laws_in_use(world)
    assert used.materials == (("ice", "wood"), None) and used.of_pair == (0, 1, 1, 1, 0, 1)
    assert world.law_of(2, 0) is world.law_of(0, -1) is world.law_between("wood", "ice") is used.laws[0]
    assert world.law_of(1, -1) is world.law_between("wood", "wood") is world.contact


def test_laws_of_pairs_are_checked_as_the_others_are() -> None:
    world = replace(world_of(brick("a", "ice")), ground_material="wood")
    with pytest.raises(InputDataError, match=r"friction\[ice,wood\] is -0.1 1"):
        require_physical(replace(world, pair_laws={("ice", "wood"): law(-0.1)}))
    short = replace(world, pair_laws={("ice", "wood"): law(0.3, 1e-4)})
    assert largest_step(short) < largest_step(world)
    with pytest.raises(InputDataError, match="beyond the bound of its contacts"):
        require_physical(short)
    published = PaperLaw.of_rows(batch(0.3), batch(1e4), batch(1.0))
    with pytest.raises(UsageError, match="'published' has no laws of pairs of materials"):
        require_physical(replace(short, contact=published))
