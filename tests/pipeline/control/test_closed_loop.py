"""Closed-loop steps against open-loop rollouts and the renderer of datasets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.pipeline.control import ClosedLoop, Reach, Velocity
from cgwm.pipeline.geometry.rotation import quat_exp
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.fused.launch import launch
from cgwm.pipeline.physics.fused.rollout import Launch, roll
from cgwm.pipeline.physics.fused.stepping import FusedStepper
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.runtime import kernel_build
from cgwm.schemas import InputDataError, Light, NotConvergedError, UsageError
from helpers import fused_host
from helpers.small_model import small_model

CUDA = torch.cuda.is_available() and kernel_build.available()
NEEDS_CUDA = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")
DEVICES = ["cpu", pytest.param("cuda", marks=NEEDS_CUDA)]
NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")
DT, STEPS, SPEED = 0.02, 8, 0.3


def camera(width: int = 64, height: int = 48) -> Camera:
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0, 0], [0, -0.5, np.sqrt(0.75)], [0, -np.sqrt(0.75), -0.5]])
    T[:3, 3] = (0.05, -0.45, 0.3)
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=T)


def start() -> State:
    """Return the cube a little above the table, turned and moving, and the tip beside it."""
    position = torch.tensor([[[0.0, 0.0, 0.056], [0.085, 0.005, 0.05]]], dtype=torch.float64)
    quat = quat_exp(torch.tensor([[[0.05, 0.02, 0.1], [0.0, 0.0, 0.0]]], dtype=torch.float64))
    velocity, omega = torch.zeros_like(position), torch.zeros_like(position)
    velocity[0, 0] = torch.tensor([0.2, 0.0, -0.2])
    omega[0, 0] = torch.tensor([0.0, 1.0, 0.5])
    return State(position, quat, velocity, omega)


def pushed(steps: int = STEPS) -> tuple[Drive, list[Velocity]]:
    """Return the tip's way in one piece, and its commands step by step: forward, then back."""
    generator = torch.Generator().manual_seed(0)
    velocity = torch.tensor([-SPEED, 0.0, 0.0]) + 0.05 * torch.randn(1, steps, 3, generator=generator)
    velocity[:, steps // 2 :, 0] *= -1
    velocity, omega = velocity.double(), torch.randn(1, steps, 3, generator=generator).double()
    times = DT * torch.arange(steps + 1, dtype=torch.float64)[None]
    first = start()
    drive = Drive.from_velocities(times, first.position_m[:, 1], first.quat_wxyz[:, 1], velocity, omega)
    return drive, [Velocity(v, w) for v, w in zip(velocity[0], omega[0], strict=True)]


@pytest.mark.parametrize("device", DEVICES)
def test_steps_are_those_of_one_rollout_and_frames_those_of_datasets(device: str) -> None:
    model = small_model(driven=True)
    drive, commands = pushed()
    world = world_of_model(model)
    expected = rollout(world, start(), drive.times_s[0], {"tip": drive})
    loop = ClosedLoop(model, camera(), DT, device)
    frames, states = [loop.reset(start())], []
    for command in commands:
        frame, state = loop.step({"tip": command})
        frames.append(frame)
        states.append(state)
    assert float((expected.velocity_m_s[0, -1, 0] - expected.velocity_m_s[0, 0, 0]).norm()) > 0.1, "nothing touched"
    for name in State.__dataclass_fields__:
        found = torch.cat([getattr(state, name) for state in states]).cpu()
        # the kernel keeps what the torch engine keeps, in another order of sums
        tolerance = 1e-9 if device == "cpu" else 1e-6
        # a driven body has the velocity of the interval that ends, in the rollout that of the one that begins
        bodies = [0] if name in ("velocity_m_s", "omega_body_rad_s") else [0, 1]
        torch.testing.assert_close(
            found[:, bodies], getattr(expected, name)[0, 1:][:, bodies], atol=tolerance, rtol=0, msg=name
        )
    poses = expected.position_m[0].numpy(), expected.quat_wxyz[0].numpy()
    shown = np.concatenate([block.image for block in LabelRenderer(model, {"c": camera()}).blocks(*poses)])
    found = torch.stack(frames).cpu().numpy()
    assert found.dtype == np.uint8
    assert found.shape == (STEPS + 1, 48, 64, 3)
    assert np.abs(found.astype(int) - shown).max() <= (1 if device == "cpu" else 3)
    assert np.abs(found[0].astype(int) - found[-1]).max() > 50, "nothing moved"


@pytest.mark.parametrize(
    ("device", "run", "lanes"),
    [
        pytest.param("cpu", fused_host.run, 8, marks=NEEDS_COMPILER, id="eight threads of a warp"),
        pytest.param("cuda", None, None, marks=NEEDS_CUDA, id="cuda"),
    ],
)
def test_the_kernel_goes_on_where_it_ended(device: str, run: Launch | None, lanes: int | None) -> None:
    world, (drive, _) = world_of_model(small_model(driven=True), device=device), pushed()
    first = State(*(value.to(device) for value in vars(start()).values()))
    whole = Drive(*(value.to(device) for value in vars(drive).values()))
    expected = roll(run or launch, world, first, whole.times_s, {"tip": whole}, lanes=lanes)
    stepper = FusedStepper(world, DT, run, lanes)
    for _ in range(2):  # the second time after a reset
        pieces = [_piece(drive, k) for k in range(STEPS)]
        stepper.reset(first, {"tip": pieces[0]})
        for k, piece in enumerate(pieces):
            stepper.command({"tip": piece})
            state = stepper.advance()
            torch.testing.assert_close(state.position_m[0], expected.position_m[0, k + 1], atol=1e-12, rtol=0)
            torch.testing.assert_close(state.velocity_m_s[0, 0], expected.velocity_m_s[0, k + 1, 0], atol=1e-8, rtol=0)


def _piece(drive: Drive, k: int) -> Drive:
    """Return the k-th interval of a drive as a command of its own, times from 0."""
    times = drive.times_s[:, k : k + 2] - drive.times_s[:, k : k + 1]
    fields = (drive.position_m, drive.quat_wxyz, drive.velocity_m_s, drive.omega_world_rad_s)
    return Drive(times, *(field[:, k : k + 2] for field in fields), drive.last * 0)


@pytest.mark.parametrize("device", DEVICES)
def test_a_reset_begins_anew(device: str) -> None:
    loop = ClosedLoop(small_model(driven=True), camera(), DT, device)
    runs = []
    for _ in range(2):
        frames = [loop.reset(start()).cpu()]
        for _ in range(3):
            frame, state = loop.step({"tip": Velocity((-0.2, 0, 0))})
            frames.append(frame.cpu())
        runs.append((torch.stack(frames), state.position_m.cpu()))
    assert torch.equal(runs[0][0], runs[1][0])
    assert torch.equal(runs[0][1], runs[1][1])


def test_a_driven_body_reaches_its_pose() -> None:
    loop = ClosedLoop(small_model(driven=True), camera(16, 12), DT)
    loop.reset(start())
    quat = quat_exp(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    for k in range(3):
        target = (0.1, 0.01 * k, 0.06)
        _, state = loop.step({"tip": Reach(target, quat if k else None)})
        np.testing.assert_allclose(state.position_m[0, 1].numpy(), target, atol=1e-12)
    assert abs(float(state.quat_wxyz[0, 1] @ quat)) == pytest.approx(1.0, abs=1e-12)
    assert loop.body_names == ["cube", "tip"]


@pytest.mark.parametrize("device", DEVICES)
def test_a_glossy_body_with_edges_turns_in_its_light(device: str) -> None:
    model = small_model()
    splats = model.body_splats["cube"]
    faces = np.where(np.abs(splats.means) < np.abs(splats.means).max(1, keepdims=True), 0.0, np.sign(splats.means))
    glossy = 0.1 * np.random.default_rng(2).normal(size=(len(splats.means), 3, 3))
    model = replace(model, body_splats={"cube": replace(splats, normals=faces, harmonics=glossy)})
    model = replace(model, file=model.file.model_copy(update={"light": Light(lamp=(0.8, 0.0, 0.3), sky=0.2)}))
    one = State(*(value[:, :1] for value in vars(start()).values()))
    loop = ClosedLoop(model, camera(), DT, device)
    frames = [loop.reset(one), loop.step()[0]]
    state = loop.step()[1]
    frames.append(loop.reset(State(*(value.cpu() for value in vars(state).values()))))
    position = torch.cat((one.position_m[0], state.position_m[0].cpu())).numpy()[:, None]
    quat = torch.cat((one.quat_wxyz[0], state.quat_wxyz[0].cpu())).numpy()[:, None]
    shown = np.concatenate([block.image for block in LabelRenderer(model, {"c": camera()}).blocks(position, quat)])
    for frame, picture in zip((frames[0], frames[2]), shown, strict=True):
        assert np.abs(frame.cpu().numpy().astype(int) - picture).max() <= (1 if device == "cpu" else 3)


def test_wrong_commands_and_starts_are_refused() -> None:
    loop = ClosedLoop(small_model(driven=True), camera(16, 12), DT)
    with pytest.raises(UsageError, match="before the first reset"):
        loop.step({"tip": Velocity((0, 0, 0))})
    loop.reset(start())
    with pytest.raises(UsageError, match="no command for 'tip'"):
        loop.step()
    with pytest.raises(UsageError, match="'cube', which is not driven"):
        loop.step({"tip": Velocity((0, 0, 0)), "cube": Velocity((0, 0, 0))})
    with pytest.raises(UsageError, match=r"3 finite numbers"):
        loop.step({"tip": Velocity((0, 0))})
    with pytest.raises(InputDataError, match=r"position_m has the shape \(1, 1, 3\)"):
        loop.reset(State(*(value[:, :1] for value in vars(start()).values())))
    deep = start()
    deep.position_m[0, 0, 2] = 0.0
    with pytest.raises(InputDataError, match="deep inside the ground"):
        loop.reset(deep)
    with pytest.raises(UsageError, match="control interval of 0 s"):
        ClosedLoop(small_model(), camera(), 0.0)
    with pytest.raises(InputDataError, match="nothing to see"):
        ClosedLoop(small_model(visible=False), camera(), DT)


def test_a_state_that_diverges_is_said() -> None:
    loop = ClosedLoop(small_model(driven=True), camera(16, 12), DT)
    loop.reset(start())
    with pytest.raises(NotConvergedError, match="control step 1: the state is not finite"):
        loop.step({"tip": Velocity((1e308, 1e308, 1e308))})
