"""Tosses of a two-link elbow with a free hinge: cgwm against MuJoCo with the same URDF, both fitted to the same tosses.

    python benchmarks/elbow.py elbow_tosses.tar.xz --work out/elbow              # judged on training tosses left out
    python benchmarks/elbow.py elbow_tosses.tar.xz --work out/elbow --held-out   # judged on the 70 held-out tosses
    python benchmarks/elbow.py --pool out/elbow_0 out/elbow_1   # errors of runs with --seed 0 and 1, averaged

The 270 tosses (DAIRLab/dair_pll, BSD-3) are split by a fixed seed into 200 and 70. Both are fitted to the same of the
200 (`fit` takes 100, evenly spread), from the same states at the first frames, which cgwm estimates from the first
0.1 s with the masses of the URDF. MuJoCo's friction, solref, hinge damping, dry friction, ratio of masses, inertia and
height of the ground are fitted by CEM, in the same coordinates and from the same priors, to the same error (mean
distance of surface points), for at least the CPU time of `cgwm fit`. Errors are open loop: means over both links and
all frames after the warm-up. A fit that is in --work is kept. MuJoCo's collision geometry are the boxes, cgwm's are
spheres within them. Both searches draw by chance: with other seeds the errors of either move by some percent.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets import Capture, import_elbow, read_model
from cgwm.datasets.capture.links import articulations_of
from cgwm.datasets.capture.tracks import Episode
from cgwm.datasets.models.model import Model
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.chains.state import joints_of, with_joints
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.parameters import GROUND_SHIFT, Parameter
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.initial_state import estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import PhysConfig
from numpy.typing import NDArray

from cgwm import fit

mujoco: Any = importlib.import_module("mujoco")
mujoco_rollout: Any = importlib.import_module("mujoco.rollout")

Array = NDArray[np.float64]
TRAIN, TEST, SEED, FITTED = 200, 70, 0, 100
SUBSTEPS = 7
"""Steps of MuJoCo between two frames: 0.97 ms each."""
POPULATION, ELITES, GENERATIONS = 43, 10, 8
"""Of CEM; generations go on until the CPU time of `cgwm fit` is reached."""
SOLREF = (0.006, 0.7), (0.7, 0.6)
"""Median and standard deviation of the logarithm of MuJoCo's time constant [s] and damping ratio."""


@dataclass(frozen=True)
class Tosses:
    """Tosses (E) with the states at their first frames."""

    names: tuple[str, ...]
    """Episodes."""
    seen: Observations
    """Poses of both links (E, T, 2)."""
    warm: NDArray[np.bool_]
    """Frames of the warm-up, shape (E, T)."""
    world: World
    """The world of the URDF."""

    def angles(self) -> Array:
        """Return the measured angles of the hinge [rad], shape (E, T)."""
        frames = self.seen.times_s.shape[1]
        rows = [_flat(x[:, :, :2]) for x in (self.seen.position_m, self.seen.quat_wxyz)]
        return hinge(self.world, rows[0], rows[1]).reshape(-1, frames)


def _flat(values: torch.Tensor) -> torch.Tensor:
    return values.flatten(0, 1)


def hinge(world: World, position: torch.Tensor, quat: torch.Tensor) -> Array:
    """Return the angle of the hinge (n,) [rad] from poses of the links (n, 2, 3) and (n, 2, 4)."""
    zero = torch.zeros_like(position)
    return joints_of(world, State(position, quat, zero, zero), world.chains[0], exact=False)[0][:, 0].numpy()


def tosses_of(model: Model, capture: Capture, names: Sequence[str], noise: Noise) -> Tosses:
    """Return tosses with states that the world of the URDF fits to their first 0.1 s."""
    world = world_of_model(model)
    episodes = [Episode(name, capture.tracks(name)) for name in names]
    spans = [(-1.0, 10.0)] * len(episodes)
    seen = Observations.of(world, episodes, spans)
    warm = warmup_frames(world, seen, 0.1)
    seen, _ = estimate_states(world, seen, warm, noise)
    return Tosses(tuple(names), seen, warm.numpy(), world)


def errors(tosses: Tosses, position: Array, quat: Array) -> dict[str, Array]:
    """Return mean errors of each toss after its warm-up (E,): translation [mm], rotation and hinge [deg]."""
    after = ~tosses.warm & (tosses.seen.seen[..., 0].numpy() > 0)
    moved = np.linalg.norm(position - tosses.seen.position_m.numpy(), axis=-1).mean(-1)
    cosine = np.abs((quat * tosses.seen.quat_wxyz.numpy()).sum(-1)).clip(0, 1)
    turned = (2 * np.arccos(cosine)).mean(-1)
    frames = position.shape[1]
    flat = [torch.as_tensor(x.reshape(-1, *x.shape[2:])) for x in (position, quat)]
    away = hinge(tosses.world, flat[0], flat[1]).reshape(-1, frames) - tosses.angles()
    bent = np.abs((away + np.pi) % (2 * np.pi) - np.pi)

    def mean(values: Array) -> Array:
        return (np.where(after, np.nan_to_num(values, nan=1e3), 0.0)).sum(1) / after.sum(1)

    size = 0.5 * np.linalg.norm([0.1, 0.05, 0.05])
    return {
        "translation_mm": 1e3 * mean(moved),
        "rotation_deg": np.degrees(mean(turned)),
        "hinge_deg": np.degrees(mean(bent)),
        "surface_mm": 1e3 * mean(np.sqrt(moved**2 + (size * turned) ** 2)),
    }


def by_cgwm(world: World, tosses: Tosses) -> dict[str, Array]:
    """Return the errors of the fitted world."""
    with torch.no_grad():
        found = rollout(world, tosses.seen.state, tosses.seen.times_s, {})
    return errors(tosses, found.position_m[:, :, :2].numpy(), found.quat_wxyz[:, :, :2].numpy())


class Rival:
    """MuJoCo's model of the elbow.

    Args:
        capture: The capture, whose URDF is loaded.
    """

    def __init__(self, capture: Capture, world: World) -> None:
        urdf = (capture.root / "elbow.urdf").read_text()
        urdf = urdf[: urdf.index("<drake:collision_filter_group")] + "</robot>"
        while "<drake:" in urdf:
            start = urdf.index("<drake:")
            stop = urdf.index("</drake:", start)
            urdf = urdf[:start] + urdf[urdf.index(">", stop) + 1 :]
        spec = mujoco.MjSpec.from_string(urdf)
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        root = spec.worldbody.first_body()
        if not root.joints:
            root.add_freejoint()
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = (2, 1) if geom.name == "ground" else (1, 2)
            geom.condim = 3
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.timestep = 0.0068 / SUBSTEPS
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.mass, self.inertia = self.model.body_mass.copy(), self.model.body_inertia.copy()
        assert self.model.nq == 8 and self.model.nv == 7, (self.model.nq, self.model.nv)
        self.world = world
        like = {p.name.split(".")[-1]: p for p in chain_parameters(world)}
        friction = Parameter(
            name="friction", unit="1", bounds=(0.01, 2), logarithmic=True, reveals="", prior=(0.3, 0.5)
        )
        times = [
            replace(friction, name=name, prior=prior, bounds=bounds)
            for name, prior, bounds in zip(("time", "ratio"), SOLREF, ((0.002, 0.1), (0.05, 3.0)), strict=True)
        ]
        losses = [like[name] for name in ("damping", "friction", "mass_factor", "inertia_factor")]
        self.parameters = [friction, *times, *losses, GROUND_SHIFT]

    def apply(self, values: Array) -> None:
        """Set fitted coordinates (8,)."""
        decoded = [float(p.decode(torch.tensor(v))) for p, v in zip(self.parameters, values, strict=True)]
        friction, time_s, ratio, damping, loss, mass, inertia, height = decoded
        model = self.model
        model.geom_friction[:, 0] = friction
        model.geom_solref[:] = (time_s, ratio)
        model.dof_damping[6], model.dof_frictionloss[6] = damping, loss
        raw = self.mass * np.array([0.0, 1.0, mass])
        model.body_mass[:] = raw * self.mass.sum() / raw.sum()
        share = np.divide(model.body_mass, self.mass, out=np.ones(3), where=self.mass > 0)
        model.body_inertia[:] = self.inertia * (share * inertia)[:, None]
        model.geom_pos[model.geom("ground").id, 2] = height
        mujoco.mj_setConst(model, self.data)

    def motion(self, values: Array, tosses: Tosses) -> tuple[Array, Array]:
        """Return positions (E, T, 2, 3) and quaternions (E, T, 2, 4) of tosses under fitted coordinates (8,)."""
        self.apply(values)
        state = tosses.seen.state
        angle, rate = (x[:, 0].numpy() for x in joints_of(self.world, state, self.world.chains[0]))
        root = [x[:, 0].numpy() for x in state.tensors]
        qpos = np.concatenate([root[0], root[1], angle[:, None]], 1)
        qvel = np.concatenate([root[2], root[3], rate[:, None]], 1)
        first = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], 1)
        frames = tosses.seen.times_s.shape[1]
        states, _ = mujoco_rollout.rollout(self.model, self.data, first, nstep=SUBSTEPS * (frames - 1))
        rows = np.concatenate([first[:, None], states[:, SUBSTEPS - 1 :: SUBSTEPS]], 1)[..., 1:9]
        flat = torch.as_tensor(np.nan_to_num(rows.reshape(-1, 8)))
        zero = torch.zeros(len(flat), 2, 3, dtype=torch.float64)
        quat = torch.zeros(len(flat), 2, 4, dtype=torch.float64)
        quat[..., 0] = 1.0
        position = zero.clone()
        position[:, 0], quat[:, 0] = flat[:, :3], flat[:, 3:7]
        name = self.world.chains[0].joint_names[0]
        posed = with_joints(self.world, State(position, quat, zero, zero), {name: flat[:, 7]})
        shape = (len(rows), frames, 2)
        return posed.position_m.numpy().reshape(*shape, 3), posed.quat_wxyz.numpy().reshape(*shape, 4)

    def errors(self, values: Array, tosses: Tosses) -> dict[str, Array]:
        """Return the errors of fitted coordinates (8,)."""
        return errors(tosses, *self.motion(values, tosses))


def surface_errors(drawn: Array, rival: Rival, tosses: Tosses) -> tuple[Array, float]:
    """Return the mean surface errors (n,) [mm] of coordinates (n, 8), and the CPU time [s]."""
    began = time.process_time()
    return np.array([rival.errors(one, tosses)["surface_mm"].mean() for one in drawn]), time.process_time() - began


def fitted_by_cem(rival: Rival, tosses: Tosses, cpu_s: float, seed: int, workers: int) -> tuple[Array, float]:
    """Return the coordinates that CEM finds, and its CPU time [s], that of all processes together."""
    rng, spent = np.random.default_rng(seed), 0.0
    mean = np.array([p.encode(p.prior[0]) for p in rival.parameters])
    std = np.array([p.prior[1] for p in rival.parameters])
    limits = np.array([p.limits for p in rival.parameters])
    generation, best = 0, (np.inf, mean)
    while generation < GENERATIONS or spent < cpu_s:
        drawn = rng.normal(mean, std, (POPULATION, len(mean))).clip(*limits.T)
        drawn[0] = mean
        parts = np.array_split(drawn, workers)
        # forked processes have the rival and the tosses, which cannot be sent to them
        with ProcessPoolExecutor(workers, get_context("fork"), _share, (rival, tosses)) as pool:
            costs, times = zip(*pool.map(_shared_errors, parts), strict=True)
        cost, spent = np.concatenate(costs), spent + sum(times)
        order = np.argsort(cost)[:ELITES]
        best = min(best, (float(cost[0]), mean.copy()), key=lambda pair: pair[0])
        mean, std = drawn[order].mean(0), np.maximum(drawn[order].std(0), 0.02)
        generation += 1
        print(f"  generation {generation}: {cost.min():.2f} mm, mean's {cost[0]:.2f} mm", flush=True)
    last = float(rival.errors(mean, tosses)["surface_mm"].mean())
    return (mean if last <= best[0] else best[1]), spent


_shared: list[Any] = []


def _share(*given: Any) -> None:
    _shared[:] = given


def _shared_errors(drawn: Array) -> tuple[Array, float]:
    return surface_errors(drawn, *_shared)


def judged(name: str, ours: dict[str, Array], theirs: dict[str, Array]) -> dict[str, dict[str, float]]:
    """Print and return means, medians and the paired differences of the errors on some tosses."""
    table = {}
    for key, mine in ours.items():
        away = mine - theirs[key]
        table[key] = {
            "cgwm_mean": mine.mean(),
            "mujoco_mean": theirs[key].mean(),
            "cgwm_median": float(np.median(mine)),
            "mujoco_median": float(np.median(theirs[key])),
            "difference": away.mean(),
            "std_error": away.std(ddof=1) / np.sqrt(len(away)),
        }
        row = table[key]
        print(
            f"{name:10s} {key:15s} cgwm {row['cgwm_mean']:7.2f} ({row['cgwm_median']:6.2f})  mujoco "
            f"{row['mujoco_mean']:7.2f} ({row['mujoco_median']:6.2f})  difference {row['difference']:+.2f} "
            f"+- {row['std_error']:.2f}"
        )
    return {key: {k: float(v) for k, v in row.items()} for key, row in table.items()}


def run(source: Path, work: Path, held_out: bool, seed: int, workers: int) -> dict[str, Any]:
    """Fit both and compare them."""
    work.mkdir(parents=True, exist_ok=True)
    if not (work / "capture").exists():
        import_elbow(source, work / "capture", TRAIN, TEST, SEED)
    capture = Capture.open(work / "capture")
    if not (work / "fit_s.txt").exists():
        started = time.process_time()
        fit(work / "capture", work / "model", "phys-geo", overwrite=True, phys_config=PhysConfig(seed=seed))
        (work / "fit_s.txt").write_text(f"{time.process_time() - started:.1f}")
    cpu_s = float((work / "fit_s.txt").read_text())
    model = read_model(work / "model")
    found = articulations_of(capture.root, capture.manifest)
    plain = nominal(model, found)
    noise = Noise(*(model.file.measurement_std[key] for key in ("position_m", "rotation_rad")))
    names = capture.episodes("train")
    chosen = np.linspace(0, len(names) - 1, FITTED).round().astype(int)
    fitted = tosses_of(plain, capture, [names[k] for k in chosen], noise)
    left = [name for k, name in enumerate(names) if k not in set(chosen.tolist())]
    rival = Rival(capture, fitted.world)
    print(f"cgwm fit: {cpu_s:.0f} s of CPU; CEM of MuJoCo:")
    coordinates, rival_s = fitted_by_cem(rival, fitted, cpu_s, seed, workers)
    world = world_of_model(model)
    sets = {"fitted": fitted, "left out": tosses_of(plain, capture, left, noise)}
    if held_out:
        sets["held out"] = tosses_of(plain, capture, capture.episodes("test"), noise)
    tosses = {
        name: {"cgwm": by_cgwm(world, one), "mujoco": rival.errors(coordinates, one)} for name, one in sets.items()
    }
    tables = {name: judged(name, *both.values()) for name, both in tosses.items()}
    values = {p.name: float(p.decode(torch.tensor(v))) for p, v in zip(rival.parameters, coordinates, strict=True)}
    print(f"CPU: cgwm {cpu_s:.0f} s, MuJoCo {rival_s:.0f} s; MuJoCo's numbers: {values}")
    by_toss = {
        name: {who: {key: row.tolist() for key, row in found.items()} for who, found in both.items()}
        for name, both in tosses.items()
    }
    return {"cpu_s": {"cgwm": cpu_s, "mujoco": rival_s}, "mujoco": values, "errors": tables, "tosses": by_toss}


def pooled(runs: Sequence[Path]) -> None:
    """Print the comparison of the errors of each toss, averaged over runs."""
    found = [json.loads((run / "elbow.json").read_text())["tosses"] for run in runs]
    for name, both in found[0].items():
        mine, theirs = (
            {key: np.mean([one[name][who][key] for one in found], 0) for key in both[who]} for who in ("cgwm", "mujoco")
        )
        judged(name, mine, theirs)


def nominal(model: Model, found: dict[str, Any]) -> Model:
    """Return the model with the masses and inertias of the URDF, and joints without losses."""
    links = {link.name: link for one in found.values() for link in one.links}
    bodies = []
    for body in model.file.bodies:
        link = links[body.name]
        rows = link.inertia_kg_m2
        six = (*rows.diagonal().tolist(), rows[0, 1], rows[0, 2], rows[1, 2])
        bodies.append(body.model_copy(update={"mass_kg": link.mass_kg, "inertia_kg_m2": tuple(map(float, six))}))
    joints = tuple(
        one.model_copy(
            update={"joints": tuple(j.model_copy(update={"damping": 0.0, "friction": 0.0}) for j in one.joints)}
        )
        for one in model.file.articulations
    )
    return replace(model, file=model.file.model_copy(update={"bodies": tuple(bodies), "articulations": joints}))


def main() -> None:
    """Run the benchmark and write `elbow.json` into the working folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, nargs="?")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--pool", type=Path, nargs="+", metavar="WORK", help="average earlier runs")
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--seed", type=int, default=0, help="of both searches")
    parser.add_argument("--workers", type=int, default=1, help="processes of CEM")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.pool:
        pooled(given.pool)
        return
    if given.source is None or given.work is None:
        parser.error("give SOURCE and --work, or --pool")
    result = run(given.source, given.work, given.held_out, given.seed, given.workers)
    (given.work / "elbow.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
