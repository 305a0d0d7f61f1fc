"""The true scene in our engine: true shape, mass and friction, for the floor of what our law of contact can express."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.datasets.synthetic.dynamics import FINGERTIP, FINGERTIP_RADIUS, GRAVITY, STEPS_PER_S, ContactTruth
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import EpisodePlan, ScenePlan
from cgwm.pipeline.physics.contact_law import ContactLaw
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from cgwm.pipeline.physics.world import Body, State, World
from cgwm.pipeline.sg_gs.collision_spheres import fills_hull, shape_to_spheres
from cgwm.schemas import FileShape, Shape
from cgwm.schemas.materials import pair_of
from numpy.typing import NDArray

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
    mesh = Mesh(solid.vertices, solid.faces)
    with tempfile.TemporaryDirectory() as folder:
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
        (Path(folder) / "object.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
        found, distance = shape_to_spheres(Shape(mesh=FileShape(path="object.obj")), Path(folder), SPHERES, 1.0)
    centers, radii = np.asarray(found.means, np.float64), np.asarray(found.scales, np.float64)
    volume = float(np.einsum("fi,fi->", mesh.vertices[mesh.faces[:, 0]], np.cross(*_edges(mesh))) / 6)
    return Spheres(centers, radii, fills_hull(centers, radii, volume), float(distance))


def _edges(mesh: Mesh) -> tuple[Array, Array]:
    return mesh.vertices[mesh.faces[:, 1]], mesh.vertices[mesh.faces[:, 2]]


@dataclass(frozen=True)
class Numbers:
    """What our law of contact says of a ground beside its friction: natural time [s] and damping ratio [1]."""

    contact_time_s: float
    damping_ratio: float


def true_world(solid: SolidObject, spheres: Spheres, contact: ContactTruth, fingertip: bool, numbers: Numbers) -> World:
    """Return the world of true shape, mass and frictions under given numbers of the law."""

    def tensor(value: object) -> torch.Tensor:
        return torch.as_tensor(np.asarray(value), dtype=torch.float64)[None]

    def law(friction: float) -> ContactLaw:
        return ContactLaw(tensor(friction), tensor(numbers.contact_time_s), tensor(numbers.damping_ratio))

    centers, radii = tensor(spheres.centers), tensor(spheres.radii)
    on_plane = plane_contacts(centers[0], radii[0])
    thing = Body(
        name=OBJECT, motion="free", mass=tensor(solid.mass), inertia=tensor(solid.inertia), com=tensor(solid.com),
        centers=centers, radii=radii, on_plane=on_plane, material=OBJECT,
        hull=Hull.of(centers[0], radii[0], on_plane) if spheres.convex else None,
    )  # fmt: skip
    tip = Body(
        name=FINGERTIP, motion="driven", mass=tensor(1.0), inertia=tensor(np.eye(3)), com=tensor(np.zeros(3)),
        centers=tensor(np.zeros((1, 3))), radii=tensor(np.full(1, FINGERTIP_RADIUS)), material=FINGERTIP,
    )  # fmt: skip
    on_ground = law(contact.friction)
    return World(
        bodies=(thing, tip) if fingertip else (thing,),
        gravity=tensor([0.0, 0.0, -GRAVITY]),
        ground_normal=tensor([0.0, 0.0, 1.0])[0],
        ground_offset=tensor(0.0),
        contact=on_ground,
        pair_laws={pair_of(OBJECT, FINGERTIP): law(contact.friction_fingertip)} if fingertip else {},
        ground_material=GROUND,
    )


def pose_errors(world: World, plan: ScenePlan, episode: EpisodePlan) -> tuple[float, float]:
    """Return the mean error of place [mm] and orientation [deg] of an open-loop prediction over the video's frames.

    Raises:
        ArithmeticError: If the prediction is not finite.
    """
    motion = episode.motion
    times = np.arange(episode.frame_count) / plan.frame_rate
    truth = motion.qpos[motion.rows(times)]
    place, turn = _predicted(world, episode, times)
    if not (np.isfinite(place).all() and np.isfinite(turn).all()):
        raise ArithmeticError(f"the prediction of episode {episode.name} diverges")
    shift = np.linalg.norm(place - truth[:, :3], axis=1)[1:].mean()
    angle = 2 * np.arccos(np.abs((turn * truth[:, 3:7]).sum(1)).clip(0, 1))[1:].mean()
    return 1e3 * float(shift), float(np.degrees(angle))


def _predicted(world: World, episode: EpisodePlan, times_s: Array) -> tuple[Array, Array]:
    motion = episode.motion
    row = motion.row(0.0)
    pose, rate = motion.qpos[row], motion.qvel[row]
    tracks = {FINGERTIP: _track(episode)} if len(world.bodies) > 1 else {}
    start = State(*(_stacked(len(world.bodies), values) for values in (pose[:3], pose[3:7], rate[:3], rate[3:6])))
    with torch.no_grad():
        rollout = measure(world, start, torch.as_tensor(times_s), tracks)
    return rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy()


def _stacked(bodies: int, values: Array) -> torch.Tensor:
    """Return the object's values (1, bodies, n); others stand unturned at the origin until tracks place them."""
    rest = np.zeros_like(values) if len(values) == 3 else np.array([1.0, 0, 0, 0])
    return torch.as_tensor(np.stack([values, *[rest] * (bodies - 1)]), dtype=torch.float64)[None]


def _track(episode: EpisodePlan) -> Track:
    motion, every = episode.motion, STEPS_PER_S // _TRACK_HZ
    rows = np.arange(motion.row(0.0), len(motion.qpos), every)
    turns = np.tile([1.0, 0, 0, 0], (len(rows), 1))
    return Track(motion.start + rows / STEPS_PER_S, motion.qpos[rows, 7:10], turns)
