"""The true scene in our engine: true shape, mass and friction, for the floor of what our law of contact can express."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.shapes.meshes import mass_properties, read_mesh
from cgwm.datasets.synthetic.dynamics import FINGERTIP, FINGERTIP_RADIUS, GRAVITY, STEPS_PER_S, ContactTruth
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EpisodePlan, ScenePlan
from cgwm.pipeline.physics.body import Body
from cgwm.pipeline.physics.contact_law import ContactLaw
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.sg_gs.collision.collision_spheres import fills_hull, shape_to_spheres
from cgwm.schemas import FileShape, Shape
from cgwm.schemas.materials import pair_of
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SPHERES = 200
"""Most collision spheres, as in `cgwm fit`."""
OBJECT, GROUND = "object", "ground"
_TRACK_HZ = 240


@dataclass(frozen=True)
class Spheres:
    """The collision spheres of a true object; they take seconds to find.

    Args:
        centers: Body frame [m], shape (n, 3).
        radii: Shape (n,) [m].
        convex: Whether they fill their hull, so that faces are flat.
        distance_m: Largest distance of their surface from the true one [m].
    """

    centers: Array
    radii: Array
    convex: bool
    distance_m: float


def spheres_of(solid: SolidObject) -> Spheres:
    """Fill a true object with spheres as `cgwm fit` does with a mesh."""
    with tempfile.TemporaryDirectory() as folder:
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in solid.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (solid.faces + 1).tolist()]
        (Path(folder) / "object.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return spheres_in(Path(folder), "object.obj")


def spheres_in(folder: Path, mesh: str) -> Spheres:
    """Fill the solid of a mesh file in a folder with spheres as `cgwm fit` does."""
    found, distance = shape_to_spheres(Shape(mesh=FileShape(path=mesh)), folder, SPHERES, 1.0)
    centers, radii = np.asarray(found.means, np.float64), np.asarray(found.scales, np.float64)
    volume = mass_properties(read_mesh(folder / mesh)).volume_m3
    return Spheres(centers, radii, fills_hull(centers, radii, volume), float(distance))


@dataclass(frozen=True)
class Numbers:
    """What our law of contact says of a ground beside its friction: natural time [s] and damping ratio [1]."""

    contact_time_s: float
    damping_ratio: float


def true_body(spheres: Spheres, mass_kg: float, com_m: ArrayLike, inertia_kg_m2: ArrayLike) -> Body:
    """Return the object as a body with its true numbers; the inertia has shape (3, 3)."""
    centers, radii = _tensor(spheres.centers), _tensor(spheres.radii)
    on_plane = plane_contacts(centers[0], radii[0])
    return Body(
        name=OBJECT, motion="free", mass=_tensor(mass_kg), inertia=_tensor(inertia_kg_m2), com=_tensor(com_m),
        centers=centers, radii=radii, on_plane=on_plane, material=OBJECT,
        hull=Hull.of(centers[0], radii[0], on_plane) if spheres.convex else None,
    )  # fmt: skip


def on_true_ground(world: World, friction: float, friction_fingertip: float | None, numbers: Numbers) -> World:
    """Return a world whose frictions are those of the ground and of the fingertip, where there is one [1]."""
    pairs = {} if friction_fingertip is None else {pair_of(OBJECT, FINGERTIP): _law(friction_fingertip, numbers)}
    bodies = tuple(replace(one, material=one.name) for one in world.bodies)
    return replace(world, bodies=bodies, contact=_law(friction, numbers), pair_laws=pairs, ground_material=GROUND)


def true_world(solid: SolidObject, spheres: Spheres, contact: ContactTruth, fingertip: bool, numbers: Numbers) -> World:
    """Return the world of true shape, mass and frictions under given numbers of the law."""
    tip = Body(
        name=FINGERTIP, motion="driven", mass=_tensor(1.0), inertia=_tensor(np.eye(3)), com=_tensor(np.zeros(3)),
        centers=_tensor(np.zeros((1, 3))), radii=_tensor(np.full(1, FINGERTIP_RADIUS)),
    )  # fmt: skip
    thing = true_body(spheres, solid.mass, solid.com, solid.inertia)
    world = World(
        bodies=(thing, tip) if fingertip else (thing,),
        gravity=_tensor([0.0, 0.0, -GRAVITY]),
        ground_normal=_tensor([0.0, 0.0, 1.0])[0],
        ground_offset=_tensor(0.0),
        contact=_law(contact.friction, numbers),
    )
    return on_true_ground(world, contact.friction, contact.friction_fingertip if fingertip else None, numbers)


def _law(friction: float, numbers: Numbers) -> ContactLaw:
    return ContactLaw(_tensor(friction), _tensor(numbers.contact_time_s), _tensor(numbers.damping_ratio))


def _tensor(value: ArrayLike) -> torch.Tensor:
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)[None]


def pose_errors(world: World, plan: ScenePlan, episode: EpisodePlan) -> tuple[float, float]:
    """Return the mean error of place [mm] and orientation [deg] of an open-loop prediction over the video's frames.

    Raises:
        ArithmeticError: If the prediction is not finite.
    """
    times = np.arange(episode.frame_count) / plan.frame_rate
    return pose_errors_at(*_predicted(world, episode, times), episode, times)


def pose_errors_at(place: Array, turn: Array, episode: EpisodePlan, times_s: Array) -> tuple[float, float]:
    """Return the mean error of predicted places (T, 3) [mm] and orientations (T, 4) [deg] at times (T,) [s].

    Raises:
        ArithmeticError: If the prediction is not finite.
    """
    if not (np.isfinite(place).all() and np.isfinite(turn).all()):
        raise ArithmeticError(f"the prediction of episode {episode.name} diverges")
    truth = episode.motion.qpos[episode.motion.rows(times_s)]
    shift = np.linalg.norm(place - truth[:, :3], axis=1)[1:].mean()
    angle = 2 * np.arccos(np.abs((turn * truth[:, 3:7]).sum(1)).clip(0, 1))[1:].mean()
    return 1e3 * float(shift), float(np.degrees(angle))


def _predicted(world: World, episode: EpisodePlan, times_s: Array) -> tuple[Array, Array]:
    motion = episode.motion
    row = motion.row(0.0)
    tracks = {FINGERTIP: finger_track(episode)} if len(world.bodies) > 1 else {}
    start = first_state(world, motion.qpos[row], motion.qvel[row])
    with torch.no_grad():
        rollout = measure(world, start, torch.as_tensor(times_s), tracks)
    return rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy()


def first_state(world: World, qpos: Array, qvel: Array) -> State:
    """Return the state of a world whose object has a pose (7,) [m, quat_wxyz] and velocities (6,) [m/s, rad/s]."""
    parts = (qpos[:3], qpos[3:7], qvel[:3], qvel[3:6])
    return State(*(_stacked(len(world.bodies), values) for values in parts))


def _stacked(bodies: int, values: Array) -> torch.Tensor:
    """Return the object's values (1, bodies, n); others stand unturned at the origin until tracks place them."""
    rest = np.zeros_like(values) if len(values) == 3 else np.array([1.0, 0, 0, 0])
    return torch.as_tensor(np.stack([values, *[rest] * (bodies - 1)]), dtype=torch.float64)[None]


def finger_track(episode: EpisodePlan) -> Track:
    """Return the fingertip's path from time zero on: its command."""
    motion, every = episode.motion, STEPS_PER_S // _TRACK_HZ
    rows = np.arange(motion.row(0.0), len(motion.qpos), every)
    turns = np.tile([1.0, 0, 0, 0], (len(rows), 1))
    return Track(motion.start + rows / STEPS_PER_S, motion.qpos[rows, 7:10], turns)
