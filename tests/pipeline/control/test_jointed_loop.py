"""Closed-loop steps of jointed bodies: servo targets against one open-loop rollout, and what is refused."""

from dataclasses import replace

import pytest
import torch
from cgwm.datasets.models.model import Model
from cgwm.pipeline.control import ClosedLoop, Targets, Velocity
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.state import joints_of, with_joints
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.physics.fused.stepping import FusedStepper
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.rollout import simulate
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.schemas import UsageError
from helpers import fused_host
from helpers.jointed_model import HEIGHT_M, jointed_model

DT = 0.01


def served(base: str = "fixed") -> Model:
    model = jointed_model(base, (-1.0, 1.0))
    joint = model.file.articulations[0].joints[0]
    joint = joint.model_copy(update={"stiffness": 2.0, "damping": 0.05, "armature": 1e-3, "torque_limit": 1.5})
    entry = model.file.articulations[0].model_copy(update={"joints": (joint,)})
    return replace(model, file=model.file.model_copy(update={"articulations": (entry,)}))


def start(world: World, angle: float) -> State:
    position = torch.tensor([[[0.0, 0.0, HEIGHT_M]] * 2], dtype=torch.float64)
    quat = torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2], dtype=torch.float64)
    return with_joints(
        world, State(position, quat, torch.zeros_like(position), torch.zeros_like(position)), {"elbow": angle}
    )


def test_servo_targets_are_those_of_one_rollout() -> None:
    model = served()
    world = world_of_model(model)
    targets, began = [0.3, -0.2], 0.1
    loop = ClosedLoop(model, None, DT)
    frame = loop.reset(start(world, began))
    assert frame.shape == (0, 0, 3)
    found = []
    for target in targets:
        _, state = loop.step({"arm": Targets({"elbow": target})})
        found.append(joints_of(world, state, world.chains[0])[0])
    _, state = loop.step()  # the last target is held
    found.append(joints_of(world, state, world.chains[0])[0])
    times = DT * torch.arange(len(targets) + 2, dtype=torch.float64)
    knots = torch.tensor([began, *targets, targets[-1]], dtype=torch.float64)[None, :, None]
    command = JointCommand.targets(times[None], knots)
    whole = simulate(world, start(world, began), times, {"arm": command})
    for k, values in enumerate(found, 1):
        there = State(*(getattr(whole, name)[:, k] for name in State.__dataclass_fields__))
        torch.testing.assert_close(values, joints_of(world, there, world.chains[0])[0], atol=1e-8, rtol=0)
    assert abs(float(found[-1]) - began) > 0.002


def test_a_target_at_once_is_faster_than_a_linear_one() -> None:
    model = served()
    world = world_of_model(model)
    moved = []
    for hold in ("linear", "zero"):
        loop = ClosedLoop(model, None, DT)
        loop.reset(start(world, 0.0))
        _, state = loop.step({"arm": Targets({"elbow": -0.5}, hold=hold)})
        moved.append(-float(joints_of(world, state, world.chains[0])[0]))
    assert moved[1] > moved[0] + 0.001


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ({"arm": Targets({"elbo": 0.1})}, "'arm' has no joint 'elbo' with a servo.*Did you mean 'elbow'"),
        ({"arm": Targets({"elbow": float("nan")})}, "the command of 'elbow' has"),
        ({"arm": Velocity((0, 0, 0))}, "the command of the jointed body 'arm' is Velocity"),
        ({"leg": Targets({"elbow": 0.1})}, "a command for 'leg', which is not driven"),
    ],
)
def test_wrong_commands_are_refused(command: dict, words: str) -> None:
    model = served()
    loop = ClosedLoop(model, None, DT)
    loop.reset(start(world_of_model(model), 0.0))
    with pytest.raises(UsageError, match=f"(?s){words}"):
        loop.step(command)


def test_passive_joints_have_no_targets_and_driven_roots_are_refused() -> None:
    model = jointed_model("fixed")
    loop = ClosedLoop(model, None, DT)
    loop.reset(start(world_of_model(model), 0.0))
    _, state = loop.step()
    assert float(joints_of(world_of_model(model), state, world_of_model(model).chains[0])[0]) > 0.001
    with pytest.raises(UsageError, match="a command for 'arm', which is not driven"):
        loop.step({"arm": Targets({"elbow": 0.1})})
    with pytest.raises(UsageError, match="the root 'upper' of the jointed body 'arm' is driven"):
        ClosedLoop(served("driven"), None, DT)


@pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
@pytest.mark.parametrize("lanes", [pytest.param(1, marks=pytest.mark.evidence), 4])
def test_joints_go_on_where_they_ended_and_a_reset_begins_anew(lanes: int) -> None:
    """The arm falls onto its lower limit, whose impulse warm-starts the next interval."""
    world = world_of_model(served())
    chain, first, times = world.chains[0], start(world, -0.9), DT * torch.arange(7, dtype=torch.float64)
    still = JointCommand.hold_still(torch.tensor([[-1.4]], dtype=torch.float64))
    whole = roll(fused_host.run, world, first, times[None], {"arm": still}, lanes=lanes)
    assert float(joints_of(world, State(*(getattr(whole, n)[:, -1] for n in vars(first))), chain)[0]) < -0.98
    stepper = FusedStepper(world, DT, fused_host.run, lanes)
    for _ in range(2):
        stepper.reset(first, {"arm": still})
        for k in range(1, len(times)):
            stepper.command({"arm": still})
            state = stepper.advance()
            for name in vars(first):
                torch.testing.assert_close(getattr(state, name), getattr(whole, name)[:, k], atol=1e-11, rtol=0)
