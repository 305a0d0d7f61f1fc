"""This engine against MuJoCo on its own tosses: a box, a ball and a mug, contacts with 3 and 6 dimensions.

    python benchmarks/contact_truth.py [--bodies box,ball,mug] [--tosses 50] [--seed 0]

MuJoCo (Newton, elliptic cones, 0.5 ms) tosses each body onto a plane: from 10 to 20 cm, turned by chance, at up to
1 m/s along each axis and 8 rad/s. Friction, contact time, damping ratio and the height of the ground, shared by all
tosses, are fitted to half of them (the search of `phys_geo`, from the true initial states), and the other half is
predicted open loop over 0.7 s. Beside it: MuJoCo with another setting of its solver against itself, on the same tosses.

The box is touched by its 8 corners in both. The mug is the YCB scan: as spheres of `shape_to_spheres` (at most 200)
here, as the convex parts that come with it in MuJoCo; mass and inertia are those of the scan's solid in both.
"""

from __future__ import annotations

import argparse
import sys
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.geometry.mesh import mesh_mass_properties, read_mesh
from cgwm.pipeline.geometry.rotation import geodesic_angle
from cgwm.pipeline.optimization.importance_sampling import NormalPrior, importance_search
from cgwm.pipeline.phys_geo.tracks.open_loop_search import open_loop_errors
from cgwm.pipeline.physics import Body, ContactLaw, State, World, simulate
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT, apply_parameters
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.sg_gs.collision.collision_spheres import shape_to_spheres
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.schemas import BoxShape, FileShape, Shape, SphereShape
from numpy.typing import NDArray
from store import Store, shared_data

Array = NDArray[np.float64]

RATE_HZ, LENGTH_S, TRUTH_STEP_S = 100, 0.7, 5e-4
FRICTION, TORSION_M, ROLLING_M = 0.3, 0.005, 1e-4
SOLREF = (0.01, 0.4)
"""MuJoCo's time constant [s] and damping ratio; with its impedance of 0.9 to 0.95 a contact of about 4 ms."""
SPHERES, POPULATION, GENERATIONS = 200, 32, 5
OTHER_SETTINGS: dict[str, dict[str, Any]] = {
    "PGS, pyramidal": {"solver": "PGS", "cone": "pyramidal"},
    "time step 2 ms": {"timestep": 2e-3},
    "solref's time constant 20 % longer": {"solref": (1.2 * SOLREF[0], SOLREF[1])},
}


@dataclass(frozen=True)
class Thrown:
    """A body as this engine has it, and its geoms for MuJoCo (MJCF), both in the body frame."""

    body: Body
    geoms: str
    assets: str


@dataclass(frozen=True)
class Tosses:
    """Motions: times_s (T,); position_m (N, T, 3), quat_wxyz (N, T, 4), velocity_m_s, omega_body_rad_s (N, T, 3)."""

    times_s: Array
    position_m: Array
    quat_wxyz: Array
    velocity_m_s: Array
    omega_body_rad_s: Array

    def half(self, which: int) -> Tosses:
        """Return every other toss."""
        return Tosses(self.times_s, *(getattr(self, k)[which::2] for k in list(self.__dataclass_fields__)[1:]))


def box() -> Thrown:
    """Return a box of 10 x 8 x 6 cm, 400 g."""
    half, mass = np.array([0.05, 0.04, 0.03]), 0.4
    inertia = np.diag(mass / 3 * ((half**2).sum() - half**2))
    body = _body(Shape(box=BoxShape(half_extents_m=tuple(half))), Path(), mass, inertia, np.zeros(3))
    return Thrown(body, f'<geom type="box" size="{_words(half)}"/>', "")


def ball() -> Thrown:
    """Return a ball of 4 cm, 200 g."""
    radius, mass = 0.04, 0.2
    shape = Shape(sphere=SphereShape(radius_m=radius))
    body = _body(shape, Path(), mass, 0.4 * mass * radius**2 * np.eye(3), np.zeros(3))
    return Thrown(body, f'<geom type="sphere" size="{radius}"/>', "")


def mug(folder: Path) -> Thrown:
    """Return the YCB mug, 118 g."""
    properties, mass = mesh_mass_properties(read_mesh(folder / "textured.obj")), 0.118
    shape = Shape(mesh=FileShape(path="textured.obj"))
    body = _body(shape, folder, mass, mass * properties.inertia_m2, properties.com_m)
    parts = sorted(folder.glob("textured_coacd_*.stl"))
    assets = "".join(f'<mesh name="{part.stem}" file="{part}"/>' for part in parts)
    return Thrown(body, "".join(f'<geom type="mesh" mesh="{part.stem}"/>' for part in parts), assets)


def _body(shape: Shape, root: Path, mass: float, inertia: Array, com: Array) -> Body:
    spheres, _ = shape_to_spheres(shape, root, SPHERES)
    centers, radii = torch.as_tensor(spheres.means), torch.as_tensor(2 * spheres.scales)

    def one(value: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray(value, float))[None]

    on_plane = plane_contacts(centers, radii)
    return Body(
        name="body",
        motion="free",
        mass=one(mass),
        inertia=one(inertia),
        com=one(com),
        centers=centers[None],
        radii=radii[None],
        place=None,
        on_plane=on_plane,
    )


def _words(values: Any) -> str:
    return " ".join(f"{float(value):.12g}" for value in np.ravel(values))


def mujoco_model(thrown: Thrown, condim: int, settings: dict[str, Any]) -> Any:
    """Return MuJoCo's model of the body over the plane z = 0."""
    body, six = thrown.body, [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    inertia = _words([float(body.inertia[0, i, j]) for i, j in six])
    xml = f"""
    <mujoco>
      <compiler meshdir="/"/>
      <option timestep="{settings.get("timestep", TRUTH_STEP_S)}" cone="{settings.get("cone", "elliptic")}"
        solver="{settings.get("solver", "Newton")}" iterations="100" tolerance="1e-12"/>
      <default><geom condim="{condim}" friction="{settings.get("friction", FRICTION)} {TORSION_M} {ROLLING_M}"
        solref="{_words(settings.get("solref", SOLREF))}"/></default>
      <asset>{thrown.assets}</asset>
      <worldbody>
        <geom type="plane" size="5 5 1" pos="0 0 {settings.get("height_m", 0.0)}"/>
        <body name="body"><freejoint/>{thrown.geoms}
          <inertial pos="{_words(body.com[0])}" mass="{float(body.mass)}" fullinertia="{inertia}"/></body>
      </worldbody>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def starts(count: int, seed: int) -> Array:
    """Return positions and quaternions (count, 7), then velocities (count, 6), of the tosses' first moments."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(count, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    height = rng.uniform(0.1, 0.2, (count, 1))
    along, turning = rng.uniform(-1, 1, (count, 2)), rng.uniform(-8, 8, (count, 3))
    zero = np.zeros((count, 1))
    return np.concatenate([zero, zero, height + 0.06, quat, along, zero, turning], 1)


def tossed(thrown: Thrown, condim: int, start: Array, settings: dict[str, Any]) -> Tosses:
    """Return MuJoCo's motions from the given starts."""
    model = mujoco_model(thrown, condim, settings)
    data = mujoco.MjData(model)
    every, frames = round(1 / (RATE_HZ * model.opt.timestep)), round(LENGTH_S * RATE_HZ) + 1
    rows = np.empty((len(start), frames, 13))
    for toss, first in enumerate(start):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = first[:7], first[7:]
        for frame in range(frames):
            rows[toss, frame] = np.concatenate([data.qpos, data.qvel])
            mujoco.mj_step(model, data, every)
    columns = np.split(rows, [3, 7, 10], axis=2)
    return Tosses(np.arange(frames) / RATE_HZ, *columns)


def state_of(tosses: Tosses) -> State:
    """Return the states at the first frames."""
    columns = (tosses.position_m, tosses.quat_wxyz, tosses.velocity_m_s, tosses.omega_body_rad_s)
    return State(*(torch.as_tensor(column[:, :1].copy()) for column in columns))


def world_of(body: Body) -> World:
    """Return the world with the prior's contact law."""
    law = ContactLaw(*(torch.tensor([p.prior[0]], dtype=torch.float64) for p in CONTACT_PARAMETERS))
    gravity = torch.tensor([[0.0, 0.0, -9.81]], dtype=torch.float64)
    up, zero = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    return World(bodies=(body,), gravity=gravity, ground_normal=up, ground_offset=zero, contact=law)


def fitted(world: World, tosses: Tosses, seed: int) -> tuple[Array, World]:
    """Return the shared parameters and the world with them, by the search of the stage phys-geo."""
    names = [*CONTACT_PARAMETERS, GROUND_SHIFT]
    episodes = [
        Episode(f"toss{k}", {"body": Track(tosses.times_s, tosses.position_m[k], tosses.quat_wxyz[k])})
        for k in range(len(tosses.position_m))
    ]
    observations = Observations.of(world, episodes, [(0.0, LENGTH_S + 1e-9)] * len(episodes))
    observations = Observations(**{**vars(observations), "state": state_of(tosses)})
    warm = torch.zeros_like(observations.times_s, dtype=torch.bool)
    prior = NormalPrior(
        np.array([p.encode(p.prior[0]) for p in names]),
        np.array([p.prior[1] for p in names]),
        np.array([p.limits for p in names]),
    )
    found = importance_search(
        open_loop_errors(world, observations, warm, names),
        prior,
        seed=seed,
        population=POPULATION,
        generations=GENERATIONS,
        errors=3.0 * len(episodes),
        floor=1e-6,
    )
    values = torch.stack([p.decode(torch.tensor(v)) for p, v in zip(names, found.mean, strict=True)])
    return values.numpy(), apply_parameters(world, names, values[None])


def errors(truth: Tosses, position_m: Array, quat_wxyz: Array) -> dict[str, float]:
    """Return mean and median over tosses of the mean errors over the frames [mm, degrees]."""
    shift = 1e3 * np.linalg.norm(position_m - truth.position_m, axis=-1).mean(1)
    angle = geodesic_angle(torch.as_tensor(quat_wxyz), torch.as_tensor(truth.quat_wxyz))
    turn = np.rad2deg(angle.numpy()).mean(1)
    figures = {
        "mean_mm": shift.mean(),
        "median_mm": np.median(shift),
        "mean_deg": turn.mean(),
        "median_deg": np.median(turn),
    }
    return {name: round(float(value), 3) for name, value in figures.items()}


def measure(make: Callable[[], Thrown], condim: int, count: int, seed: int) -> dict[str, Any]:
    """Toss, fit to one half and predict the other; then MuJoCo with other settings on that half."""
    thrown = make()
    start = starts(count, seed)
    truth = tossed(thrown, condim, start, {})
    values, world = fitted(world_of(thrown.body), truth.half(0), seed)
    held_out = truth.half(1)
    with torch.no_grad():
        rollout = simulate(world, state_of(held_out), torch.as_tensor(held_out.times_s))
    figures: dict[str, Any] = {
        "spheres": thrown.body.radii.shape[1],
        "parameters": {
            p.name: round(float(v), 5) for p, v in zip([*CONTACT_PARAMETERS, GROUND_SHIFT], values, strict=True)
        },
        "cgwm": errors(held_out, rollout.position_m[:, :, 0].numpy(), rollout.quat_wxyz[:, :, 0].numpy()),
    }
    for name, settings in OTHER_SETTINGS.items():
        other = tossed(thrown, condim, start, settings).half(1)
        figures[f"MuJoCo, {name}"] = errors(held_out, other.position_m, other.quat_wxyz)
    return figures


def main() -> int:
    """Print one JSON line a body and number of dimensions; return 2 where the scans are not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", default="box,ball,mug")
    parser.add_argument("--tosses", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    data, store = shared_data(), Store("contact_truth")
    with tempfile.TemporaryDirectory() as folder:
        for name in words.bodies.split(","):
            if name == "mug":
                if data is None:
                    print("no scans: set CGWM_SHARED_DATA", file=sys.stderr)
                    return 2
                with tarfile.open(data / "ycb.tar.xz") as archive:
                    archive.extractall(folder, filter="data")
            makers = {"box": box, "ball": ball, "mug": lambda: mug(Path(folder) / "ycb" / "ycb" / "mug")}
            for condim in (3, 6):
                key = f"{name}, condim {condim}, {words.tosses} tosses, seed {words.seed}"
                make = makers[name]
                store.result(key, lambda make=make, c=condim: measure(make, c, words.tosses, words.seed))
    return 0


if __name__ == "__main__":
    sys.exit(main())
