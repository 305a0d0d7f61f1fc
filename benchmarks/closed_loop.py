"""Closed-loop prediction: physics and a 640x480 frame per control step, one environment, against the published 40 Hz.

python benchmarks/closed_loop.py [--device cuda|cpu] [--steps N] [--size WxH] [--dtype float64|float32|both]

A seeded cube of 2,500 visual and 218 colliding spheres over a table of 6,084, physics steps of 1 ms. "free" tosses the
cube and lets it settle; in "pushed" a fingertip goes to where the state says that the cube is, at 0.1 m/s. Every two
seconds of motion it starts anew (not timed). A step is timed from the command to the end of the device's work; with
"readback" to the frame in the host's memory. One JSON line each.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import platform
import sys
import time

import numpy as np
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.control.closed_loop import ClosedLoop, Command, Velocity
from cgwm.pipeline.physics.state import State
from cgwm.schemas import BodyModel, ContactParameters, Ground, ModelFile, Pose, Provenance, Solver

PUBLISHED_HZ = 40.0
HALF_M, MASS_KG, TIP_RADIUS_M, TIP_SPEED_M_S = 0.05, 0.37, 0.006, 0.1
VISUAL, TABLE_SIDE, COLLIDING_SIDE = 2500, 78, 7
EPISODE_S, WARMUP = 2.0, 50


def cube(rng: np.random.Generator) -> tuple[Splats, Splats]:
    """Return the visual spheres over the cube's faces, and the colliding ones: a shell of a grid, flush with them."""
    points = rng.uniform(-HALF_M, HALF_M, (VISUAL, 3))
    axis = rng.integers(0, 3, VISUAL)
    rows = np.arange(VISUAL)
    points[rows, axis] = np.sign(points[rows, axis]) * 0.97 * HALF_M
    visual = Splats(points, np.full(VISUAL, 0.12 / math.sqrt(VISUAL)), np.full(VISUAL, 0.9), rng.random((VISUAL, 3)))
    radius = 1.2 * HALF_M / COLLIDING_SIDE
    along = np.linspace(-1, 1, COLLIDING_SIDE) * (HALF_M - radius)
    grid = np.stack(np.meshgrid(along, along, along), -1).reshape(-1, 3)
    centers = grid[np.abs(grid).max(1) > HALF_M - radius - 1e-9]
    count = len(centers)
    # the collision radius is twice the scale
    return visual, Splats(centers, np.full(count, radius / 2), np.full(count, 0.9), np.full((count, 3), 0.5))


def table(rng: np.random.Generator, side_m: float = 0.6) -> Splats:
    """Return the scene's spheres: a square with its top at height 0."""
    line = np.linspace(-side_m, side_m, TABLE_SIDE)
    xy = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    scale = 1.2 * side_m / TABLE_SIDE
    means = np.c_[xy, np.full(len(xy), -0.5 * scale)]
    return Splats(means, np.full(len(xy), scale), np.full(len(xy), 0.95), rng.uniform(0.3, 0.7, (len(xy), 3)))


def model(pushed: bool) -> Model:
    """Return the model, with the fingertip where it is pushed."""
    rng = np.random.default_rng(0)
    moment = MASS_KG / 6 * (2 * HALF_M) ** 2
    visual, colliding = cube(rng)
    bodies = [
        BodyModel(
            name="cube",
            motion="free",
            mass_kg=MASS_KG,
            inertia_kg_m2=(moment, moment, moment, 0, 0, 0),
            com_m=(0, 0, 0),
            photo_pose=Pose(position_m=(0, 0, HALF_M)),
        )
    ]
    splats, collision = {"cube": visual}, {"cube": colliding}
    if pushed:
        tip = Splats(np.zeros((1, 3)), np.array([TIP_RADIUS_M / 2]), np.array([0.95]), np.array([[1.0, 0, 0]]))
        inertia = (1e-5, 1e-5, 1e-5, 0, 0, 0)
        bodies.append(BodyModel(name="tip", motion="driven", mass_kg=0.1, inertia_kg_m2=inertia, com_m=(0, 0, 0)))
        splats["tip"] = collision["tip"] = tip
    file = ModelFile(
        ground=Ground(),
        bodies=tuple(bodies),
        contact=ContactParameters(friction=0.3, contact_time_s=0.004, damping_ratio=0.3),
        solver=Solver(step_s=0.001),
        provenance=Provenance(capture="none"),
    )
    return Model(root=None, file=file, body_splats=splats, collision=collision, scene=table(rng))


def camera(width: int, height: int) -> Camera:
    """Return a camera 0.6 m from the cube, 30 degrees above the table; the table fills the lower half of its frame."""
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0, 0], [0, -0.5, math.sqrt(0.75)], [0, -math.sqrt(0.75), -0.5]])
    T[:3, 3] = (0.0, -0.52, 0.34)
    K = np.array([[1.1 * height, 0, width / 2], [0, 1.1 * height, height / 2], [0, 0, 1.0]])
    return Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=T)


def start(rng: np.random.Generator, pushed: bool) -> State:
    """Return a tossed cube; or one that rests, with the fingertip beside it."""
    bodies = 2 if pushed else 1
    position, velocity, omega = np.zeros((3, 1, bodies, 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (1, bodies, 1))
    if pushed:
        position[0] = (0.0, 0.0, HALF_M), (HALF_M + 0.02, rng.uniform(-0.02, 0.02), rng.uniform(0.03, 0.07))
    else:
        position[0, 0] = (*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.12, 0.25))
        quat[0, 0] = rng.normal(size=4)
        quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
        velocity[0, 0], omega[0, 0] = rng.normal(0, 0.3, 3), rng.normal(0, 4, 3)
    return State(*(torch.as_tensor(values) for values in (position, quat, velocity, omega)))


def command(state: State | None, pushed: bool) -> dict[str, Command]:
    """Return the fingertip's velocity: to the cube as it lies now, in the plane."""
    if not pushed:
        return {}
    if state is None:
        return {"tip": Velocity((-TIP_SPEED_M_S, 0.0, 0.0))}
    body, tip = state.position_m[0].tolist()
    x, y = body[0] - tip[0], body[1] - tip[1]
    factor = TIP_SPEED_M_S / max(math.hypot(x, y), 1e-6)
    return {"tip": Velocity((factor * x, factor * y, 0.0))}


def measure(
    device: str, dtype: str, pushed: bool, control_hz: float, readback: bool, steps: int, size: tuple[int, int]
) -> dict[str, object]:
    """Return the speed of one case."""
    cuda = device.startswith("cuda")
    width, height = size
    loop = ClosedLoop(model(pushed), camera(width, height), 1 / control_hz, device, getattr(torch, dtype))
    host = torch.empty(height, width, 3, dtype=torch.uint8, pin_memory=cuda)
    rng = np.random.default_rng(1)
    per_episode = round(EPISODE_S * control_hz)
    times, moved, warmup = [], 0.0, min(WARMUP, steps)
    state = None
    for k in range(warmup + steps):
        if k % per_episode == 0:
            state = None
            begin = start(rng, pushed)
            loop.reset(begin)
        began = time.perf_counter()
        frame, state = loop.step(command(state, pushed))
        if readback:
            host.copy_(frame, non_blocking=True)
        if cuda:
            torch.cuda.synchronize()
        if k >= warmup:
            times.append(time.perf_counter() - began)
        if k % per_episode == per_episode - 1:
            moved = max(moved, float((state.position_m[0, 0].cpu() - begin.position_m[0, 0]).norm()))
    slow, middle, fast = np.percentile(times, (95, 50, 5))
    return {
        "case": "pushed" if pushed else "free",
        "control_hz": control_hz,
        "readback": readback,
        "dtype": dtype,
        "size": f"{width}x{height}",
        "steps": steps,
        "steps_per_s": {"median": _short(1 / middle), "p5": _short(1 / slow), "p95": _short(1 / fast)},
        "median_ms": _short(1e3 * middle),
        "ratio_to_published_40_hz": _short(1 / middle / PUBLISHED_HZ),
        "moved_m": _short(moved),
    }


def _short(value: float) -> float:
    return float(f"{value:.4g}")


def main() -> int:
    """Print one JSON line a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--dtype", choices=("float64", "float32", "both"), default="both")
    options = parser.parse_args()
    width, height = (int(number) for number in options.size.split("x"))
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        print("no CUDA device; --device cpu measures the torch engine")
        return 1
    name = torch.cuda.get_device_name() if options.device.startswith("cuda") else platform.machine()
    print(json.dumps({"machine": name, "torch": torch.__version__}), flush=True)
    dtypes = ("float64", "float32") if options.dtype == "both" else (options.dtype,)
    for dtype, pushed, control_hz, readback in itertools.product(dtypes, (False, True), (30.0, 100.0), (False, True)):
        case = (options.device, dtype, pushed, control_hz, readback, options.steps, (width, height))
        print(json.dumps(measure(*case)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
