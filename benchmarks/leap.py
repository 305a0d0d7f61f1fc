"""Cost of a sub-step of a robot hand that turns a cube: cgwm on the CPU or CUDA, MuJoCo and MuJoCo Warp beside it.

    python benchmarks/leap.py leap_hand/robots/hands/leap_hand/leap_hand_right.urdf --environments 64
    python benchmarks/leap.py ... --device cuda --single --environments 4096

The hand is the LEAP hand (16 joints; dexsuite/dex-urdf, MIT) with about 160 spheres, the cube has 64. Servos close the
fingers to random targets at knots, so that the cube is held and rolled. CPU figures are CPU time of the process for
each environment and sub-step; those of CUDA are wall time of all environments together, from the call to the last
frame, the median of several rollouts. MuJoCo runs on the CPU; MuJoCo Warp, where it is installed, on CUDA.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.robots import read_articulation
from cgwm.pipeline.physics import Body, ContactLaw, State, World
from cgwm.pipeline.physics.chains.articulated import Servo, chain_of
from cgwm.pipeline.physics.chains.joint_command import JointCommand
from cgwm.pipeline.physics.chains.state import with_joints
from cgwm.pipeline.physics.devices import on_device
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.fused import simulate_fused
from cgwm.pipeline.sg_gs.collision.link_spheres import link_spheres
from numpy.typing import NDArray
from torch import Tensor

HALF_M, SIDE = 0.0325, 4
STIFFNESS, DAMPING, ARMATURE = 3.0, 0.1, 1e-3
REPEATS = 7
"""Rollouts on CUDA that are timed; the first ones allocate memory."""


def scene(urdf: Path, spheres: Path | None, massless: bool, step_s: float) -> World:
    """Return the hand, palm up, and a cube on it."""
    hand = read_articulation(urdf).welded()
    if spheres is not None and spheres.exists():
        stored = np.load(spheres)
        found = {link.name: (stored[f"{link.name}_c"], stored[f"{link.name}_r"]) for link in hand.links}
    else:
        found = link_spheres(hand, 160)
        if spheres is not None:
            arrays: dict[str, Any] = {
                f"{k}_{n}": v for k, pair in found.items() for n, v in zip("cr", pair, strict=True)
            }
            np.savez(spheres, **arrays)
    chain, links = chain_of(
        hand, found, "fixed", Servo(stiffness=STIFFNESS, damping=DAMPING, armature=ARMATURE), massless=massless
    )
    radius = HALF_M / SIDE
    ticks = torch.linspace(-1, 1, SIDE, dtype=torch.float64) * (HALF_M - radius)
    mass = 0.108

    def one(value: object) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64)[None]

    cube = Body(
        name="cube", motion="free", mass=one(mass), inertia=one(mass * 2 / 3 * HALF_M**2 * np.eye(3)),
        com=one([0.0, 0.0, 0.0]), centers=torch.cartesian_prod(ticks, ticks, ticks)[None],
        radii=torch.full((1, SIDE**3), radius, dtype=torch.float64),
    )  # fmt: skip
    law = ContactLaw(one(0.5), one(0.005), one(1.0))
    return World(
        bodies=(*links, cube), gravity=one([9.81, 0.0, 0.0]), ground_normal=None, ground_offset=None, contact=law,
        step_s=step_s, chains=(chain,),
    )  # fmt: skip


def start(world: World, environments: int, seed: int) -> tuple[State, JointCommand]:
    """Return states with the cube above the palm, and commands that close the fingers."""
    generator = torch.Generator().manual_seed(seed)
    bodies, chain = len(world.bodies), world.chains[0]
    zero = torch.zeros(environments, bodies, 3, dtype=torch.float64)
    turn = torch.zeros(environments, bodies, 4, dtype=torch.float64)
    turn[..., 0] = 1.0
    place = zero.clone()
    place[:, -1] = torch.tensor([-0.055, 0.01, 0.115]) + 0.003 * torch.randn(environments, 3, generator=generator)
    state = with_joints(world, State(place, turn, zero, zero.clone()), {})
    lower, upper = chain.numbers("lower")[0], chain.numbers("upper")[0]
    count = len(chain.moving)
    share = 0.35 + 0.3 * torch.rand(environments, 5, count, generator=generator, dtype=torch.float64)
    side = torch.tensor([name in ("0", "4", "8") for name in chain.joint_names])
    wanted = torch.where(side, 0.3 * (share - 0.5), (share * upper).clamp(max=1.2))
    wanted[:, 0] = 0.0
    knots = torch.linspace(0, 0.8, 5, dtype=torch.float64)[None]
    return state, JointCommand.targets(knots, torch.maximum(torch.minimum(wanted, upper), lower), "linear")


def contacts(world: World, state: State, command: JointCommand, seconds: float) -> float:
    """Return the mean number of contacts that act in a frame of the first environments."""
    few = state.at(slice(0, 4))
    frames = torch.linspace(0, seconds, 9, dtype=torch.float64)
    found = rollout(world, few, frames, {world.chains[0].name: command.select(torch.arange(len(few.position_m)))}, True)
    assert found.contacts is not None
    return float((found.contacts.impulse_n_s[:, 1:].norm(dim=-1) > 0).sum(-1).double().mean())


def measure(
    world: World, environments: int, seconds: float, device: str, single: bool, lanes: int | None = None
) -> dict[str, float]:
    """Return the cost of an environment's sub-step, and what the cube does; `lanes` are threads of CUDA."""
    state, command = start(world, environments, 0)
    acting = contacts(world, state, command, seconds)
    frames = torch.linspace(0, seconds, 3, dtype=torch.float64)
    kind = torch.float32 if single else torch.float64
    world, state = on_device(world, device, kind), on_device(state, device, kind)
    frames, command = on_device(frames, device, kind), on_device(command, device, kind)
    driven = {world.chains[0].name: command}
    roll = rollout if lanes is None else partial(simulate_fused, lanes=lanes)
    roll(world, state, frames[:2], driven)
    spent = []
    for _ in range(REPEATS if device == "cuda" else 1):
        if device == "cuda":
            torch.cuda.synchronize()
        cpu, wall = time.process_time(), time.perf_counter()
        found = roll(world, state, frames, driven)
        if device == "cuda":
            torch.cuda.synchronize()
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = sorted(spent)[len(spent) // 2]
    steps = environments * sum(world.substeps(frames[None]))
    height = found.position_m[:, -1, -1, 0]
    return {
        "cpu_us_a_step": 1e6 * cpu / steps, "env_steps_a_s": steps / wall, "contacts": acting,
        "finite": float(torch.isfinite(found.position_m).all()), "held": float((height.abs() < 0.15).double().mean()),
    }  # fmt: skip


def mujoco_model(urdf: Path, step_s: float) -> Any:
    """Return MuJoCo's model of the same URDF, servos and cube."""
    import mujoco

    text = urdf.read_text()
    compiler = (
        f'<mujoco><compiler strippath="false" discardvisual="true" meshdir="{urdf.parent}" fusestatic="true"/></mujoco>'
    )
    spec = mujoco.MjSpec.from_string(text.replace("<link", f"{compiler}<link", 1))
    names = [joint.name for joint in spec.joints]
    for joint in spec.joints:
        joint.armature = ARMATURE
    for name in names:
        actuator = spec.add_actuator(name=f"servo{name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=STIFFNESS, kv=DAMPING)
    cube = spec.worldbody.add_body(name="cube", pos=[-0.055, 0.01, 0.115])
    cube.add_freejoint()
    cube.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[HALF_M] * 3, mass=0.108)
    spec.option.gravity, spec.option.timestep = [9.81, 0.0, 0.0], step_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    model.geom_contype[:-1], model.geom_conaffinity[:-1] = 1, 2  # the links touch the cube alone
    model.geom_contype[-1], model.geom_conaffinity[-1] = 2, 1
    return model


def wanted_angles(model: Any, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return random targets of the joints (count, 16) for a MuJoCo model."""
    share = 0.35 + 0.3 * rng.random((count, model.nu))
    return np.clip(share * model.jnt_range[model.actuator_trnid[:, 0], 1], None, 1.2)


def mujoco_cost(urdf: Path, seconds: float, step_s: float) -> dict[str, float]:
    """Return the CPU time of a step of MuJoCo, one environment."""
    import mujoco

    model = mujoco_model(urdf, step_s)
    data = mujoco.MjData(model)
    rng, count = np.random.default_rng(0), 0
    began, steps = time.process_time(), round(seconds / step_s)
    for k in range(steps):
        if k % max(1, steps // 5) == 0:
            data.ctrl[:] = wanted_angles(model, rng, 1)[0]
        mujoco.mj_step(model, data)
        count += data.ncon
    return {"mujoco_us_a_step": 1e6 * (time.process_time() - began) / steps, "mujoco_contacts": count / steps}


def warp_cost(
    urdf: Path, environments: int, seconds: float, step_s: float, iterations: tuple[int, int] | None
) -> dict[str, Any]:
    """Return the steps a second of MuJoCo Warp in a CUDA graph, the median of several rollouts of all environments.

    Args:
        urdf: The hand.
        environments: Their number.
        seconds: Duration of a rollout [s].
        step_s: Step [s].
        iterations: Maximum number of iterations of the solver and of its line search; None: MuJoCo's.
    """
    import mujoco
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    host = mujoco_model(urdf, step_s)
    if iterations is not None:
        host.opt.iterations, host.opt.ls_iterations = iterations
    first = mujoco.MjData(host)
    mujoco.mj_forward(host, first)
    model = mjw.put_model(host)
    data = mjw.put_data(host, first, nworld=environments, nconmax=32, njmax=160)
    rng = np.random.default_rng(0)
    qpos, qvel = (wp.array(np.tile(row, (environments, 1)), dtype=float) for row in (first.qpos, first.qvel))
    mjw.step(model, data)  # compiles
    with wp.ScopedCapture() as capture:
        mjw.step(model, data)
    steps, spent, touching = round(seconds / step_s), [], 0.0
    for _ in range(REPEATS):
        wp.copy(data.qpos, qpos)
        wp.copy(data.qvel, qvel)
        targets = [wp.array(wanted_angles(host, rng, environments), dtype=float) for _ in range(5)]
        wp.synchronize()
        began = time.perf_counter()
        for k in range(steps):
            if k % max(1, steps // 5) == 0:
                wp.copy(data.ctrl, targets[min(k // max(1, steps // 5), 4)])
            wp.capture_launch(capture.graph)
        wp.synchronize()
        spent.append(time.perf_counter() - began)
        touching = float(data.nacon.numpy()[0]) / environments
    return {
        "mujoco_warp": getattr(mjw, "__version__", "?"), "environments": environments, "iterations": iterations,
        "env_steps_a_s": environments * steps / sorted(spent)[len(spent) // 2], "contacts_at_the_end": touching,
        "finite": bool(np.isfinite(data.qpos.numpy()).all()),
    }  # fmt: skip


def main() -> None:
    """Measure what the command line asks for, and print one JSON object a line."""
    parser = argparse.ArgumentParser(description="Cost of a sub-step of a hand that turns a cube.")
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--spheres", type=Path, help="file that keeps the spheres between runs")
    parser.add_argument("--environments", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=0.8)
    parser.add_argument("--step", type=float, default=0.004)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--single", action="store_true")
    parser.add_argument("--lanes", type=int, nargs="*", default=[None], help="threads of an environment on CUDA")
    arguments = parser.parse_args()
    for massless in (False, True):
        world = scene(arguments.urdf, arguments.spheres, massless, arguments.step)
        spheres = sum(body.radii.shape[-1] for body in world.bodies)
        for lanes in arguments.lanes:
            found = measure(world, arguments.environments, arguments.seconds, arguments.device, arguments.single, lanes)
            links = "without mass" if massless else "with mass"
            print(json.dumps({"links": links, "spheres": spheres, "lanes": lanes, **found}), flush=True)
    try:
        print(json.dumps(mujoco_cost(arguments.urdf, arguments.seconds, arguments.step)), flush=True)
    except ImportError:
        print("mujoco is not installed")
    if arguments.device == "cuda" and all(importlib.util.find_spec(name) for name in ("mujoco_warp", "warp")):
        for environments, iterations in itertools.product((arguments.environments, 16_384), ((5, 8), None)):
            found = warp_cost(arguments.urdf, environments, arguments.seconds, arguments.step, iterations)
            print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
