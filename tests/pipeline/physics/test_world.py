"""What a world keeps of itself."""

from dataclasses import replace

from cgwm.pipeline.physics.world import World
from helpers.small_model import small_model


def test_what_depends_on_the_world_alone_is_made_once_for_each_world() -> None:
    world, asked = World.from_model(small_model()), []

    def step(given: World) -> float:
        asked.append(given)
        return given.step_s

    other = replace(world, step_s=0.5 * world.step_s)
    assert [world.once(step), other.once(step), world.once(step)] == [world.step_s, other.step_s, world.step_s]
    assert [x is world for x in asked] == [True, False]
