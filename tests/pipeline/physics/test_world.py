"""What a world keeps of itself."""

import math
from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from helpers.small_model import small_model
from helpers.worlds import ball_body, batch, world_of


def test_what_depends_on_the_world_alone_is_made_once_for_each_world() -> None:
    world, asked = world_of_model(small_model()), []

    def step(given: World) -> float:
        asked.append(given)
        return given.step_s

    other = replace(world, step_s=0.5 * world.step_s)
    assert [world.once(step), other.once(step), world.once(step)] == [world.step_s, other.step_s, world.step_s]
    assert [x is world for x in asked] == [True, False]


def test_what_depends_on_a_start_is_kept_until_the_start_is_another_one_or_is_changed_in_place() -> None:
    world, times, asked = world_of_model(small_model()), torch.zeros(1), []
    starts = [State(*(torch.zeros(1, 1, size) for size in (3, 4, 3, 3))) for _ in range(2)]

    def height(given: World, state: State, times_s: torch.Tensor) -> float:
        asked.append((given, state, times_s))
        return float(state.position_m[0, 0, 2])

    assert [world.latest(height, starts[0], times) for _ in range(2)] == [0, 0] and len(asked) == 1
    starts[0].position_m[0, 0, 2] = 1.0
    assert world.latest(height, starts[0], times) == 1 and len(asked) == 2
    assert world.latest(height, starts[1], times) == 0 and len(asked) == 3
    assert world.latest(height, starts[0], times) == 1 and len(asked) == 4


def test_a_convex_body_alone_on_the_ground_has_no_hull_and_moves_as_with_one() -> None:
    model = small_model()
    bodies = tuple(body.model_copy(update={"convex": True}) for body in model.file.bodies)
    model = replace(model, file=model.file.model_copy(update={"bodies": bodies}))
    bare, hulled = world_of_model(model), world_of_model(model, joins_others=True)
    assert bare.bodies[0].hull is None and hulled.bodies[0].hull is not None
    start = State(
        *(torch.tensor([[x]]).double() for x in ([0.0, 0.0, 0.1], [0.8, 0.6, 0.0, 0.0], [1.0, 0, 0], [0.0] * 3))
    )
    times = torch.linspace(0, 0.5, 6).double()
    moved = [rollout(world, start, times) for world in (bare, hulled)]
    assert torch.equal(moved[0].position_m, moved[1].position_m) and moved[0].position_m[0, -1, 0, 2] < 0.09
    assert torch.equal(moved[0].quat_wxyz, moved[1].quat_wxyz)


@pytest.mark.parametrize("gravity", [(0.3, 0.0, -0.4), (0.0, 0.0, -9.81)])
def test_up_is_a_unit_vector_against_gravity_however_weak(gravity: tuple[float, float, float]) -> None:
    world = replace(world_of(ball_body()), gravity=batch(list(gravity)))
    torch.testing.assert_close(world.up, -world.gravity / math.hypot(*gravity))
