"""Rollouts per second against MuJoCo and MuJoCo Warp, and the time of a value and Jacobian for fitting.

python benchmarks/rollout.py [--only NAME ...] [--lanes]

A free cube of 64 spheres (4 x 4 x 4) falls on a plane, tumbles and comes to rest: 4 s in steps of 2 ms (2 s of 65,536),
every environment from another pose. "fused" is `simulate_fused` in float32, the state and all contacts written every
10th step; "unlabelled" is without them, "bare" with one sweep instead of 10 as well: what no labels and no accuracy
would give. All figures count whole calls, from torch tensors to torch tensors. "fitting" is value and Jacobian (20
parameters) of 64 episodes of 250 steps. Rivals that are not installed are named and left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.optimization.forward_mode import batched_jacobian
from cgwm.pipeline.physics import Body, ContactLaw, Rollout, State, World, simulate
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.fused import simulate_fused
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, apply_parameters
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.runtime import kernel_build
from store import Store
from torch import Tensor

STEP_S, LABEL_EVERY, SIDE, HALF_M, MASS_KG = 0.002, 10, 4, 0.05, 0.4
FRICTION, CONTACT_TIME_S, DAMPING_RATIO = 0.3, 0.004, 0.3
STEPS = {4096: 2000, 65_536: 1000}
EPISODES, EPISODE_STEPS, PARAMETERS = 64, 250, 20
REPEATS = 5


def spheres() -> tuple[Tensor, float]:
    """Return the centres (64, 3) [m] of the cube's spheres and their radius [m], which overlap a little."""
    radius = 1.2 * HALF_M / SIDE
    along = torch.linspace(-1, 1, SIDE, dtype=torch.float64) * (HALF_M - radius)
    return torch.cartesian_prod(along, along, along), radius


def world_of(device: str, dtype: torch.dtype, sweeps: int = 10) -> World:
    """Return the cube over the plane."""

    def tensor(value: object) -> Tensor:
        return torch.as_tensor(value, dtype=dtype, device=device)[None]

    centers, radius = spheres()
    radii = torch.full((len(centers),), radius, dtype=torch.float64)
    inertia = MASS_KG / 6 * (2 * HALF_M) ** 2 * torch.eye(3, dtype=torch.float64)
    com = torch.zeros(3, dtype=torch.float64)
    touching = plane_contacts(centers, radii).to(device)
    body = Body(
        name="cube",
        motion="free",
        mass=tensor(MASS_KG),
        inertia=tensor(inertia),
        com=tensor(com),
        centers=tensor(centers),
        radii=tensor(radii),
        place=None,
        on_plane=touching,
    )
    law = ContactLaw(tensor(FRICTION), tensor(CONTACT_TIME_S), tensor(DAMPING_RATIO))
    up = tensor([0.0, 0.0, 1.0])[0]
    return World(
        bodies=(body,),
        gravity=tensor([0.0, 0.0, -9.81]),
        ground_normal=up,
        ground_offset=tensor(0.0),
        contact=law,
        step_s=STEP_S,
        iterations=sweeps,
    )


def starts(count: int) -> tuple[np.ndarray, ...]:
    """Return positions, quaternions, velocities and spins of thrown cubes, 10 to 30 cm above the ground."""
    rng = np.random.default_rng(0)
    position = np.concatenate([np.zeros((count, 2)), rng.uniform(0.1, 0.3, (count, 1))], 1)
    quat = rng.normal(size=(count, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return position, quat, rng.normal(size=(count, 3)) * 0.5, rng.normal(size=(count, 3)) * 5


def state_of(count: int, device: str, dtype: torch.dtype) -> State:
    """Return the starts as a state."""
    return State(*(torch.as_tensor(value, dtype=dtype, device=device)[:, None] for value in starts(count)))


def frames_of(steps: int, every: int, device: str, dtype: torch.dtype) -> Tensor:
    """Return the times of every so many steps [s]."""
    return (torch.arange(steps // every + 1, dtype=torch.float64) * (every * STEP_S)).to(device, dtype)


def seconds(call: Callable[[], object], repeats: int = REPEATS, warmups: int = 2) -> float:
    """Return the median time of a call [s]; the device's work is waited for."""
    times = []
    for index in range(warmups + repeats):
        started = time.perf_counter()
        call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if index >= warmups:
            times.append(time.perf_counter() - started)
    return statistics.median(times)


def rate(environments: int, steps: int, took_s: float, **more: Any) -> dict[str, Any]:
    """Return the figures of a run."""
    figures = {"environments": environments, "steps": steps, "call_ms": round(1e3 * took_s, 3)}
    return {**figures, "env_steps_per_s": float(f"{environments * steps / took_s:.4g}"), **more}


def fused(count: int, labels: bool = True, sweeps: int = 10, lanes: int | None = None) -> dict[str, Any]:
    """Measure the fused kernel."""
    steps, dtype = STEPS[count], torch.float32
    world, state = world_of("cuda", dtype, sweeps), state_of(count, "cuda", dtype)
    times = frames_of(steps, LABEL_EVERY if labels else steps, "cuda", dtype)

    def call() -> Rollout:
        return simulate_fused(world, state, times, None, labels, lanes=lanes)

    started = time.perf_counter()
    last = call()
    torch.cuda.synchronize()
    first_s = time.perf_counter() - started
    speed, height = last.velocity_m_s[:, -1, 0].norm(dim=-1), last.position_m[:, -1, 0, 2]
    at_rest = float(((speed < 0.05) & (height < 1.1 * HALF_M)).float().mean())
    finite = bool(last.position_m.isfinite().all())
    del last
    took = seconds(call)
    return rate(count, steps, took, lanes=lanes, first_call_s=round(first_s, 2), at_rest_share=at_rest, finite=finite)


def torch_engine(count: int, device: str) -> dict[str, Any]:
    """Measure `simulate` from the same start, over fewer steps: it falls, then touches."""
    steps, dtype = 100, torch.float32
    world, state = world_of(device, dtype), state_of(count, device, dtype)
    times = frames_of(steps, LABEL_EVERY, device, dtype)
    with torch.no_grad():
        took = seconds(lambda: simulate(world, state, times, None, True), 2, 1)
    return rate(count, steps, took, threads=torch.get_num_threads())


def mjcf() -> str:
    """Return the cube and the plane for MuJoCo."""
    centers, radius = spheres()
    solref = f"{CONTACT_TIME_S / DAMPING_RATIO:g} {DAMPING_RATIO:g}"
    geoms = "".join(
        f'<geom type="sphere" size="{radius:g}" pos="{x:g} {y:g} {z:g}" mass="0"/>' for x, y, z in centers.tolist()
    )
    inertia = MASS_KG / 6 * (2 * HALF_M) ** 2
    return f"""<mujoco><option timestep="{STEP_S:g}"/>
    <default><geom friction="{FRICTION:g} 0.005 0.0001" condim="3" solref="{solref}"/></default>
    <worldbody><geom type="plane" size="10 10 1"/>
    <body pos="0 0 0.2"><freejoint/>
    <inertial pos="0 0 0" mass="{MASS_KG:g}" diaginertia="{inertia:g} {inertia:g} {inertia:g}"/>{geoms}</body>
    </worldbody></mujoco>"""


def mujoco_cpu() -> dict[str, Any]:
    """Measure MuJoCo on one thread of the CPU: 20 of the starts one after the other."""
    import mujoco

    model, count, steps = mujoco.MjModel.from_xml_string(mjcf()), 20, STEPS[4096]
    data = mujoco.MjData(model)
    started = time.perf_counter()
    for position, quat, velocity, spin in zip(*starts(count), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = [*position, *quat], [*velocity, *spin]
        mujoco.mj_step(model, data, steps)
    return rate(count, steps, time.perf_counter() - started, version=mujoco.__version__, threads=1)


def mujoco_warp(count: int) -> dict[str, Any]:
    """Measure MuJoCo Warp: a CUDA graph of one step, launched for every step; no labels are read."""
    import mujoco
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    host = mujoco.MjModel.from_xml_string(mjcf())
    state = mujoco.MjData(host)
    mujoco.mj_forward(host, state)
    model = mjw.put_model(host)
    data = mjw.put_data(host, state, nworld=count, nconmax=24, njmax=128)
    position, quat, velocity, spin = starts(count)
    qpos = wp.array(np.concatenate([position, quat], 1), dtype=float)
    qvel = wp.array(np.concatenate([velocity, spin], 1), dtype=float)
    started = time.perf_counter()
    mjw.step(model, data)  # compiles
    wp.synchronize()
    first_s = time.perf_counter() - started
    with wp.ScopedCapture() as capture:
        mjw.step(model, data)
    steps = 1000 if count <= 4096 else 250
    rates = []
    for _ in range(3):
        wp.copy(data.qpos, qpos)
        wp.copy(data.qvel, qvel)
        wp.synchronize()
        started = time.perf_counter()
        for _ in range(steps):
            wp.capture_launch(capture.graph)
        wp.synchronize()
        rates.append(time.perf_counter() - started)
    heights = data.qpos.numpy()[:, 2]
    figures = {"first_call_s": round(first_s, 1), "finite": bool(np.isfinite(heights).all())}
    return rate(count, steps, statistics.median(rates), version=getattr(mjw, "__version__", "?"), **figures)


def fitting(device: str) -> dict[str, Any]:
    """Measure value and Jacobian of poses by 12 numbers of the state, contact, ground, centre of mass and drag."""
    dtype = torch.float64
    world = world_of(device, dtype)
    named = (*CONTACT_PARAMETERS, GROUND_SHIFT, *(replace(GROUND_SHIFT, name=f"cube.com_{axis}_m") for axis in "xyz"))
    position, quat, velocity, spin = (torch.as_tensor(value, device=device) for value in starts(EPISODES))
    times = frames_of(EPISODE_STEPS, LABEL_EVERY, device, dtype)
    numbers = torch.tensor([FRICTION, CONTACT_TIME_S, DAMPING_RATIO, 0, 0, 0, 0, 0.1], dtype=dtype, device=device)
    inputs = torch.cat((position, 0 * position, velocity, spin, numbers.expand(EPISODES, -1)), 1)
    assert inputs.shape == (EPISODES, PARAMETERS)

    def rolled(values: Tensor, repeats: int) -> Tensor:
        turned = quat_multiply(quat_exp(values[:, 3:6]), quat.repeat(repeats, 1))
        state = State(*(part[:, None] for part in (values[:, :3], turned, values[:, 6:9], values[:, 9:12])))
        changed = apply_parameters(world, named, values[:, 12:19])
        drag = ActiveEffect.of(load_effect("linear_drag"), {"c": values[:, 19]}, values)
        engine = simulate_fused if device == "cuda" else simulate
        rollout = engine(replace(changed, effects=(drag,)), state, times)
        return torch.cat((rollout.position_m, rollout.quat_wxyz), -1).flatten(1)

    jacobian = batched_jacobian(rolled, inputs)[1]
    took = seconds(lambda: batched_jacobian(rolled, inputs), 3 if device == "cuda" else 1, 1 if device == "cuda" else 0)
    figures = {"episodes": EPISODES, "steps": EPISODE_STEPS, "parameters": PARAMETERS, "dtype": "float64"}
    finite = bool(jacobian.isfinite().all())
    return {**figures, "call_s": round(took, 4), "finite": finite, "threads": torch.get_num_threads()}


def main() -> None:
    """Measure all that can be, the rivals last."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", help="names to measure, or their beginnings")
    parser.add_argument("--lanes", action="store_true", help="measure other numbers of threads an environment, too")
    options = parser.parse_args()
    store, cuda = Store("rollout"), torch.cuda.is_available() and kernel_build.available()
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    tasks: dict[str, Callable[[], dict[str, Any]]] = {}
    if cuda:
        for count in STEPS:
            tasks[f"fused {count}"] = lambda count=count: fused(count)
            tasks[f"unlabelled {count}"] = lambda count=count: fused(count, False)
            tasks[f"bare {count}"] = lambda count=count: fused(count, False, 1)
            for lanes in (1, 2, 4, 8) if options.lanes else ():
                tasks[f"lanes {lanes} {count}"] = lambda count=count, lanes=lanes: fused(count, lanes=lanes)
        tasks["fitting cuda"] = lambda: fitting("cuda")
        tasks["torch cuda 4096"] = lambda: torch_engine(4096, "cuda")
    else:
        print("absent: a CUDA device with cuda.core, so the fused kernel is not measured", flush=True)
    tasks["fitting cpu"] = lambda: fitting("cpu")
    tasks["torch cpu 4096"] = lambda: torch_engine(4096, "cpu")
    absent = [name for name in ("mujoco", "mujoco_warp", "warp") if importlib.util.find_spec(name) is None]
    if "mujoco" not in absent:
        tasks["mujoco cpu"] = mujoco_cpu
    if cuda and not absent:
        for count in STEPS:
            tasks[f"mujoco warp {count}"] = lambda count=count: mujoco_warp(count)
    for name in absent:
        print(f"absent: {name}", flush=True)
    wanted = tuple(options.only or ("",))
    for name, task in tasks.items():
        if name.startswith(wanted):
            store.result(f"{name}, {device}", task)


if __name__ == "__main__":
    main()
