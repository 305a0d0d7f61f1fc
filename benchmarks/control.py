"""Planar push to a pose: cgwm's controller beside rivals, on MuJoCo with the true mesh.

python benchmarks/control.py run [--objects t_block,mug] [--first 0] [--seeds 20] [--contenders mppi,cem]
       [--clock real|ideal|cpu]
python benchmarks/control.py run --fits FOLDER --contenders "true,fitted,fitted + draws" [--plants all]
python benchmarks/control.py table

A run begins anywhere within 0.25 m of the goal, at any angle, and succeeds within 10 mm and 5 deg for 0.5 s, within
60 s. The mug's convex parts come from the archive of scans. Clocks: real charges each plan its wall time, cpu the time
of all processors (what one idle core would need), ideal nothing. Every run is a stored result.

Contenders: `mppi`, `gauss-newton`, `both`: cgwm with a model of the true shape and numbers; `cem`: CEM over MuJoCo with
the true mesh, with as many samples as the time of cgwm's plan allows; `cem + pushes`: cgwm's sampling, with its
proposals of pushes, over it; `open loop`: the commands that cgwm finds in its model, played; `greedy`: pushes from
behind, straight to the goal, then turns.

With `--fits`, FOLDER/<object> is what `cgwm demo --scene control` has written (box: seed 0, l_block: 2,
hexagonal_prism: 3, t_block: 4) or, for the mug, `fitted_mug.py`; its task is taken. `fitted` has the model of the
photos and the video, `fitted + draws` judges plans under four draws of what that fit is unsure of, `true` has the true
shape and numbers. The plants have the errors of `PLANTS`, which no controller knows.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import torch
from cgwm.datasets.models.model import Model, read_model
from cgwm.datasets.shapes.meshes import Mesh, joined_properties, read_mesh
from cgwm.datasets.shapes.ply import Splats
from cgwm.datasets.synthetic.objects import FAMILIES, hull_of, make_object, resting_down
from cgwm.pipeline.control.controller import Controller, ControlPlan, ControlState
from cgwm.pipeline.control.horizon import Targets
from cgwm.pipeline.control.loop import run
from cgwm.pipeline.control.mujoco_plant import MujocoPlant, scene_mjcf
from cgwm.pipeline.control.objective import PushObjective
from cgwm.pipeline.control.plant import ModelPlant, start_of
from cgwm.pipeline.control.proposals import GAP_M, PushProposals, Ways, outline_places
from cgwm.pipeline.control.solvers import Mppi, Solution
from cgwm.pipeline.control.task_world import outline
from cgwm.pipeline.control.wording import wilson
from cgwm.pipeline.geometry.mesh import mesh_volume
from cgwm.pipeline.sg_gs.collision.collision_spheres import distil
from cgwm.schemas import (
    JOINTS,
    BodyModel,
    ContactParameters,
    ControlTask,
    Ground,
    ModelFile,
    Pose,
    Provenance,
    read_task,
)
from processor_clock import charge_processors
from store import Store, shared_data
from tabletop.objects import load_item

OBJECTS = ("t_block", "box", "l_block", "mug")
FRICTION, FINGER_FRICTION = 0.35, 0.3
SPHERES = 64
PLANNER_STEP_S = 0.005
"""Step of MuJoCo in the plans of CEM; twice that lets the finger sink in."""
DRAWS, TRUE = 4, "true"
PLANTS: dict[str, dict[str, float]] = {
    "nominal": {},
    "friction x 0.5": {"friction_factor": 0.5},
    "friction x 2": {"friction_factor": 2.0},
    "mass x 1.5": {"mass_factor": 1.5},
    "size - 5 %": {"size_factor": 0.95},
    "size + 5 %": {"size_factor": 1.05},
    "30 ms late": {"delay_s": 0.03},
    "3 mm and 3 deg of noise": {"noise_m": 0.003, "noise_deg": 3.0},
}
"""Errors of the plant and its sensing, which the controllers do not know."""
ELITES, SPREAD = 3, (0.1, 0.6)
"""Of CEM: samples that the next mean and spread come from; smallest and largest spread in units of the limit."""


@dataclass(frozen=True)
class Scene:
    """An object, with the model that knows it exactly."""

    name: str
    model: Model
    task: ControlTask


def scene(name: str, folder: Path, fits: Path | None = None) -> Scene:
    """Return an object; its convex parts are written into the folder.

    Args:
        name: Name of the object.
        folder: Where its parts are written.
        fits: Folder of fits; None for none.
    """
    if name == "mug" and fits is None:
        parts, mass, down = _mug(folder)
        meshes = tuple(path.name for path in parts)
        every = [read_mesh(path) for path in parts]
        spheres = [distil(mesh_volume(part), SPHERES // len(parts)) for part in every]
        centers, radii = (np.concatenate([getattr(one, key) for one in spheres]) for key in ("centers", "radii"))
    elif name == "mug":
        item, meshes = load_item(name), ()  # that of `fitted_mug.py`; the task names its parts
        every, mass, down = [Mesh(item.solid.vertices, item.solid.faces)], item.solid.mass, item.down
        found = distil(mesh_volume(every[0]), SPHERES)
        centers, radii = found.centers, found.radii
    else:
        solid = make_object(FAMILIES.index(name))
        every = [_hull(part) for part in solid.parts]
        meshes = tuple(f"{name}_{k}.obj" for k in range(len(every)))
        for file, part in zip(meshes, every, strict=True):
            lines = ["v {!r} {!r} {!r}".format(*map(float, v)) for v in part.vertices]
            lines += ["f {} {} {}".format(*(face + 1)) for face in part.faces]
            (folder / file).write_text("\n".join(lines) + "\n", encoding="utf-8")
        found = distil(mesh_volume(Mesh(solid.vertices, solid.faces)), SPHERES)
        centers, radii, mass, down = found.centers, found.radii, solid.mass, resting_down(solid)
    body, collision = _body(every, mass, down, Splats(centers, radii / 2, np.full(len(radii), 0.9), _grey(len(radii))))
    task = None if fits is None else read_task(fits / name / "push.toml")
    friction = FRICTION if task is None or task.plant.friction is None else task.plant.friction
    contact = ContactParameters(friction=friction, contact_time_s=0.004, damping_ratio=0.5)
    file = ModelFile(ground=Ground(), bodies=(body,), contact=contact, provenance=Provenance(capture="none"))
    if task is not None:
        return Scene(name, Model(root=None, file=file, collision={"object": collision}), task)
    plant = {"kind": "mujoco", "meshes": meshes, "friction": FRICTION, "finger_friction": FINGER_FRICTION,
             "mass_kg": mass}  # fmt: skip
    task = ControlTask.model_validate({"plant": plant})
    task._source = str(folder / "task.toml")
    return Scene(name, Model(root=None, file=file, collision={"object": collision}), task)


def _body(parts: list[Mesh], mass: float, down: np.ndarray, spheres: Splats) -> tuple[BodyModel, Splats]:
    """Return the body at rest, with the mass properties of parts of one density."""
    solid = joined_properties(parts, "a part of the object")
    com, inertia = solid.com_m, mass * solid.inertia_per_kg
    six = tuple(float(inertia[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    quat = _upright(down)
    body = BodyModel(
        name="object",
        motion="free",
        mass_kg=mass,
        inertia_kg_m2=six,  # pyright: ignore[reportArgumentType]
        com_m=tuple(map(float, com)),  # pyright: ignore[reportArgumentType]
        photo_pose=Pose(position_m=(0.0, 0.0, 0.05), quat_wxyz=quat),
        convex=len(parts) == 1 and len(parts[0].vertices) == len(_hull(parts[0].vertices).vertices),
    )
    return body, spheres


def _upright(down: np.ndarray) -> tuple[float, float, float, float]:
    """Return the smallest rotation (w, x, y, z) that turns a direction of the body to -z."""
    axis, cosine = np.cross(down, [0.0, 0.0, -1.0]), float(-down[2])
    if cosine < -1 + 1e-9:
        return (0.0, 1.0, 0.0, 0.0)
    quat = np.array([1 + cosine, *axis])
    w, x, y, z = map(float, quat / np.linalg.norm(quat))
    return (w, x, y, z)


def _mug(folder: Path) -> tuple[list[Path], float, np.ndarray]:
    """Return the convex parts of the mug, its mass [kg] and the direction that is down, from the archive of scans."""
    data = shared_data()
    if data is None or not (data / "ycb.tar.xz").is_file():
        sys.exit("the mug needs ycb.tar.xz in the folder of measured data; leave it out: --objects t_block,box,l_block")
    parts = []
    with tarfile.open(data / "ycb.tar.xz") as archive:
        for member in archive.getmembers():
            if "/mug/textured_coacd_" in member.name and (stream := archive.extractfile(member)) is not None:
                raw = folder / Path(member.name).name
                raw.write_bytes(stream.read())
                hull = _hull(read_mesh(raw).vertices)
                raw.unlink()
                path = folder / f"mug_{len(parts)}.obj"
                lines = ["v {!r} {!r} {!r}".format(*map(float, v)) for v in hull.vertices]
                lines += ["f {} {} {}".format(*(face + 1)) for face in hull.faces]
                path.write_text("\n".join(lines) + "\n", encoding="utf-8")
                parts.append(path)
    return parts, 0.118, np.array([0.0, 0.0, -1.0])


def _hull(points: np.ndarray) -> Mesh:
    return Mesh(*hull_of(points))


def _grey(count: int) -> np.ndarray:
    return np.full((count, 3), 0.5)


@dataclass(frozen=True, kw_only=True)
class MujocoObjective(PushObjective):
    """The cost of cgwm's plans, with MuJoCo and the true mesh in place of the model."""

    simulator: Simulator
    """The scene."""

    def costs(self, values: torch.Tensor) -> torch.Tensor:
        """See `Objective`."""
        speeds = torch.cat((torch.as_tensor(self.given_m_s).expand(len(values), -1, -1), values), 1)
        speeds = self.within_limits(speeds).numpy()
        times = self.horizon.times_s - self.horizon.times_s[0]
        start = self.state.position_m[0, self.task_world.finger, :2].numpy()
        moved = np.cumsum(speeds * np.diff(times)[:, None], 1)
        places = np.concatenate((np.broadcast_to(start, (len(values), 1, 2)), start + moved), 1)
        states = self.simulator.roll(self, times, places)
        rows = self.rows(states[..., :3], states[..., 3:7], states[..., 7:9], values)
        return rows.square().sum(-1).nan_to_num(nan=math.inf)


class Simulator:
    """Batches of rollouts in MuJoCo, on all cores."""

    def __init__(self, plant: MujocoPlant) -> None:
        found = plant.found
        text = scene_mjcf(found, plant.parts).replace(
            f'timestep="{found.task.plant.step_s!r}"', f'timestep="{PLANNER_STEP_S!r}"'
        )
        self.model = mujoco.MjModel.from_xml_string(text)  # pyright: ignore[reportAttributeAccessIssue]
        count = len(os.sched_getaffinity(0))
        self.data = [mujoco.MjData(self.model) for _ in range(count)]  # pyright: ignore[reportAttributeAccessIssue]
        self.threads = mujoco.rollout.Rollout(nthread=count)

    def roll(self, objective: PushObjective, times: np.ndarray, places: np.ndarray) -> torch.Tensor:
        """Return object pose and finger (B, M, 9) at the ends of the pieces.

        Args:
            objective: What the state is of.
            times: Times of the targets [s], shape (M + 1,).
            places: Targets [m], shape (B, M + 1, 2).
        """
        state, index = objective.state, objective.task_world.object
        body = [part[0, index].numpy() for part in state.tensors]
        position, quat, velocity, omega = body
        physics = np.concatenate(([0.0], position, quat, places[0, 0], velocity, omega, [0.0, 0.0]))
        steps = max(1, round(times[-1] / PLANNER_STEP_S))
        grid = (1 + np.arange(steps)) * times[-1] / steps
        control = np.stack([[np.interp(grid, times, one[:, k]) for k in (0, 1)] for one in places]).transpose(0, 2, 1)
        found, _ = self.threads.rollout(
            [self.model] * len(places), self.data, np.tile(physics, (len(places), 1)), np.ascontiguousarray(control)
        )
        ends = np.clip(np.round(times[1:] / times[-1] * steps).astype(int) - 1, 0, steps - 1)
        return torch.as_tensor(np.asarray(found)[:, ends, 1:10])


class Cem:
    """Cross-entropy method: elites of samples about the last plan give the next mean and spread."""

    def __init__(self, samples: int) -> None:
        self.samples = samples
        self.spread: torch.Tensor | None = None

    def solve(self, objective: Any, warm: torch.Tensor, propose: Any, rng: np.random.Generator) -> Solution:
        """See `cgwm.pipeline.control.solvers.Solver`."""
        low, high = (share * objective.bound for share in SPREAD)
        spread = torch.full_like(warm, 0.5 * (low + high)) if self.spread is None else self.spread
        noise = torch.as_tensor(rng.normal(size=(self.samples - 1, *warm.shape)))
        values = torch.cat((warm[None], (warm + spread * noise).clamp(-objective.bound, objective.bound)))
        costs = objective.costs(values)
        elites = values[costs.argsort()[:ELITES]]
        self.spread = elites.std(0).clamp(low, high)
        return Solution(elites[0], float(costs.min()))


class InMujoco(Controller):
    """A controller that plans in MuJoCo with the true mesh."""

    simulator: Simulator

    def _objective(self, state: ControlState, acts_s: float) -> tuple[PushObjective, torch.Tensor]:
        """See `Controller`."""
        objective, warm = super()._objective(state, acts_s)
        return MujocoObjective(**vars(objective), simulator=self.simulator), warm


class Played(Controller):
    """Commands that were found before, whatever happens."""

    targets: Targets

    def plan(self, state: ControlState | None, acts_s: float | None = None) -> ControlPlan | None:
        """See `Controller`."""
        found = super().plan(state, acts_s) if self._plan is None else self._plan
        if state is None or found is None:
            return None
        self._plan = replace(found, targets=self.targets, state_s=state.time_s, acts_s=acts_s or state.time_s,
                             wall_s=0.0, cpu_s=0.0)  # fmt: skip
        return self._plan


class Greedy:
    """Pushes from behind the object, straight to the goal; where it lies, pushes at the place that turns it most."""

    samples = 1

    def solve(self, objective: Any, warm: torch.Tensor, propose: Any, rng: np.random.Generator) -> Solution:
        """See `cgwm.pipeline.control.solvers.Solver`."""
        where, state = objective.task_world, objective.state
        pose = state.position_m[0, where.object], state.quat_wxyz[0, where.object]
        error = where.goal.errors(*pose).numpy()
        centers, radii = outline(where, *(part.numpy() for part in pose))
        middle, ways = pose[0][:2].numpy(), Ways(centers, radii, pose[0][:2].numpy())
        places, normals = outline_places(centers, radii, np.random.default_rng(0), 200)
        away, success = -error[:2], where.task.success
        if np.linalg.norm(away) > 0.5 * success.position_m:
            aim = away / np.linalg.norm(away)
            aside = (places - middle) @ [-aim[1], aim[0]]
            best = int(np.argmin(np.abs(aside) + 0.05 * (1 + normals @ aim)))
            push = aim * (GAP_M + np.linalg.norm(away))
        else:
            arm = places - middle
            lever = -(arm[:, 0] * normals[:, 1] - arm[:, 1] * normals[:, 0]) * -math.copysign(1.0, error[2])
            best = int(np.argmax(lever))
            push = -normals[best] * (GAP_M + abs(error[2]) * np.linalg.norm(arm[best]))
        speed, finger = 0.3 * objective.bound, state.position_m[0, where.finger, :2].numpy()
        behind = finger - places[best]
        if np.linalg.norm(behind) < 2 * GAP_M and behind @ normals[best] > -GAP_M:  # it is there: go on pushing
            lasting = np.cumsum(objective.horizon.lengths_s) <= np.linalg.norm(push) / speed
            speeds = np.outer(lasting | (np.arange(len(lasting)) == 0), speed * push / np.linalg.norm(push))
        else:
            proposals = PushProposals(objective=objective)
            speeds = proposals.speeds(ways, places[best], normals[best], push, speed)
        return Solution(torch.as_tensor(speeds), 0.0)


def contender(name: str, one: Scene, fits: Path | None) -> tuple[Controller, MujocoPlant]:
    """Return a contender for an object, and the plant."""
    if name in ("mppi", "gauss-newton", "both"):
        controller = Controller(one.model, one.task, name)  # pyright: ignore[reportArgumentType]
        return controller, MujocoPlant(controller.task_world)
    if name in ("true", "fitted", "fitted + draws"):
        if fits is None:
            sys.exit(f"{name} needs --fits FOLDER with an output of 'cgwm demo --scene control' for each object.")
        model = one.model if name == "true" else read_model(fits / one.name / "model")
        controller = Controller(model, one.task, draws=DRAWS * name.endswith("draws"))
        return controller, MujocoPlant(controller.task_world)
    kind = {"cem": InMujoco, "cem + pushes": InMujoco, "open loop": Played, "greedy": Controller}[name]
    controller = kind(one.model, one.task)
    plant = MujocoPlant(controller.task_world)
    if isinstance(controller, InMujoco):
        controller.simulator = Simulator(plant)
        samples = equal_samples(controller, one, Cem if name == "cem" else Mppi)
        controller._solver = Cem(samples) if name == "cem" else Mppi(samples)
    if name == "greedy":
        controller._solver = Greedy()
    return controller, plant


def equal_samples(controller: InMujoco, one: Scene, solver: Callable[[int], Any]) -> int:
    """Return the number of samples with which a plan in MuJoCo takes the processors as long as one of cgwm."""

    def cpu_s(of: Controller) -> float:
        place, turn, finger = start_of(of.task_world, 0)
        position, quat = of.task_world.pose(place, turn)
        taken = []
        for number in range(12):
            joints = dict(zip(JOINTS, map(float, finger), strict=True))
            state = ControlState(time_s=number / 30, joints=joints, position_m=position, quat_wxyz=quat)
            plan = of.plan(state)
            taken.append(plan.cpu_s if plan else math.inf)
        of.restart(0)
        return float(np.median(taken[4:]))

    wanted = cpu_s(Controller(one.model, one.task))
    few, many = 8, 32
    times = []
    for samples in (few, many):
        controller._solver = solver(samples)
        times.append(cpu_s(controller))
    each = max((times[1] - times[0]) / (many - few), 1e-6)
    return int(np.clip(few + (wanted - times[0]) / each, 4, 1000))


def open_loop(controller: Played, one: Scene, seed: int) -> None:
    """Search the commands of an open loop: those by which cgwm reaches the goal in its own model."""
    searcher = Controller(one.model, one.task)
    found = run(searcher, ModelPlant(searcher.task_world), seed, "ideal")
    times = np.append(found.column("time_s"), found.commands["time_s"][-1] + searcher.interval_s)
    first = np.asarray(found.commands["finger_m"][0])
    controller.targets = Targets(times_s=times, values_m=np.concatenate((first[None], found.column("target_m"))))


def measure(name: str, one: Scene, seed: int, clock: str, fits: Path | None) -> dict[str, Any]:
    """Return the figures of one run."""
    controller, plant = prepared(name, one, fits)
    if isinstance(controller, Played):
        open_loop(controller, one, seed)
    if clock == "cpu":
        charge_processors(controller)
    before = os.getloadavg()[0]
    found = run(controller, plant, seed, "ideal" if clock == "ideal" else "real")
    wall, cpu = (1e3 * found.column(key, "plans") for key in ("wall_s", "cpu_s"))
    return {
        "ended": found.ended,
        "time_s": round(len(found.commands["time_s"]) * controller.interval_s, 2),
        "position_mm": round(1e3 * found.commands["position_error_m"][-1], 2),
        "turn_deg": round(found.commands["turn_error_deg"][-1], 2),
        "plans": len(wall),
        "late": found.late,
        "plan_ms": round(float(np.median(wall)), 2),
        "plan_cpu_ms": round(float(np.median(cpu)), 2),
        "samples": getattr(controller._solver, "samples", None),
        "load": round(0.5 * (before + os.getloadavg()[0]), 1),
    }


_PREPARED: dict[tuple[str, str, str], tuple[Controller, MujocoPlant]] = {}


def prepared(name: str, one: Scene, fits: Path | None) -> tuple[Controller, MujocoPlant]:
    """Return a contender, made once."""
    key = (name, one.name, one.task.plant.model_dump_json())
    if key not in _PREPARED:
        _PREPARED[key] = contender(name, one, fits)
    return _PREPARED[key]


def rows(store: Store) -> Iterator[list[str]]:
    """Yield the rows of the table: contender, object, successes, rate with interval, time, errors, plan times."""
    found: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for row in store.results():
        obj, name, clock, seed = row["key"].split("/")
        found.setdefault((clock, name, obj), {})[seed] = row
        found.setdefault((clock, name, "all"), {})[f"{obj} {seed}"] = row
    for (clock, name, obj), runs in sorted(found.items()):
        good = [run for run in runs.values() if run["ended"] == "success"]
        low, high = wilson(len(good), len(runs))
        against = f"{TRUE} | {error}" if (error := name.partition(" | ")[2]) else TRUE
        against = against if (clock, against, obj) in found else "mppi"
        reference = found.get((clock, against, obj), {})
        both = [
            (runs[key]["ended"] == "success", reference[key]["ended"] == "success") for key in runs if key in reference
        ]
        paired = ""
        if both and name != against:
            change = np.array([float(a) - float(b) for a, b in both])
            half = 1.96 * change.std(ddof=1) / math.sqrt(len(change)) if len(change) > 1 else math.nan
            paired = f"{100 * change.mean():+.0f} +- {100 * half:.0f}"
        middle = {
            key: float(np.median([run[key] for run in runs.values()])) for key in ("plan_ms", "plan_cpu_ms", "load")
        }
        time_s = f"{np.median([run['time_s'] for run in good]):.1f}" if good else "-"
        late = sum(run["late"] for run in runs.values()) / max(1, sum(run["plans"] for run in runs.values()))
        yield [clock, name, obj, f"{len(good)}/{len(runs)}", f"{100 * len(good) / len(runs):.0f} ({100 * low:.0f} to "
               f"{100 * high:.0f})", paired, time_s, f"{middle['plan_cpu_ms']:.1f}", f"{middle['plan_ms']:.0f}",
               f"{100 * late:.0f}", f"{middle['load']:.1f}"]  # fmt: skip


HEADER = ("clock", "contender", "object", "reached", "rate, % (95 %)", "against true or mppi, points",
          "time, s (median)", "plan, CPU ms", "plan, wall ms", "late, %", "load")  # fmt: skip


def main() -> None:
    """Measure what is asked for and is not there yet, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("run", "table"))
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--contenders", default="mppi,both,gauss-newton,cem,cem + pushes,open loop,greedy")
    parser.add_argument("--clock", choices=("real", "ideal", "cpu"), default="real")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--fits", type=Path, default=None, help="folder of outputs of 'cgwm demo --scene control'")
    parser.add_argument("--plants", default="nominal", help="names of PLANTS, or all")
    parser.add_argument("--store", type=Path, default=None)
    parser.add_argument("--any-commit", action="store_true", help="results of other commits count")
    given = parser.parse_args()
    store = Store("control", given.store, given.any_commit)
    if given.work == "table":
        print(" | ".join(HEADER))
        for row in rows(store):
            print(" | ".join(row))
        return
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory() as folder:
        scenes = [scene(name, Path(folder), given.fits) for name in given.objects.split(",")]
        plants = PLANTS if given.plants == "all" else given.plants.split(",")
        for seed in range(given.first, given.first + given.seeds):
            for plant, one in product(plants, scenes):
                error, changed = "" if plant == "nominal" else f" | {plant}", with_error(one, plant)
                for name in given.contenders.split(","):
                    key = f"{one.name}/{name}{error}/{given.clock}/{seed}"
                    store.result(key, lambda n=name, o=changed, s=seed: measure(n, o, s, given.clock, given.fits))


def with_error(one: Scene, plant: str) -> Scene:
    """Return an object with an error of `PLANTS`."""
    task = one.task.model_copy(update={"plant": one.task.plant.model_copy(update=PLANTS[plant])})
    return replace(one, task=task)


if __name__ == "__main__":
    main()
