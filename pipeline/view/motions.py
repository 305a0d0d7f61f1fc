"""Motions for the viewer: rollouts of a dataset, and simulations of a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...datasets.rollouts.loader import RolloutReader
from ...datasets.rollouts.replay import Replay
from ...datasets.rollouts.rollouts import ContactTable
from ...schemas import SamplingPlan, SynthesizeConfig
from ..synthesize.draw import draw_rollout
from ..synthesize.labels import joint_table
from ..synthesize.plan import resolve_plan
from ..synthesize.simulator import Diverged, Simulator
from ..synthesize.wholes import JointedStart, middle, put_links

Array = NDArray[np.float64]
Contacts = Mapping[str, NDArray[np.generic]]
"""Contacts of a frame: pos_world [m] (N, 3), impulse_world [N s] (N, 3), mode (N,), as in `RolloutReader.contacts`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A motion of the B bodies of a model over T frames."""

    times_s: Array
    """Times of the frames [s], shape (T,)."""
    position_m: Array
    """Body frame origins [m], world frame, shape (T, B, 3)."""
    quat_wxyz: Array
    """Orientations T_world_body, shape (T, B, 4)."""
    contacts: tuple[Contacts, ...]
    """Contacts of each frame."""
    contacts_known: bool = True
    """Whether contacts were recorded."""
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    """Cameras of its pictures, by name."""
    image: Callable[[str, int], NDArray[np.uint8]] | None = None
    """Function that returns the picture of a camera at a frame, uint8 RGB (H, W, 3); None without cameras."""
    joints: Mapping[str, Array] = field(default_factory=dict)
    """Values of the joints that move [rad or m], shape (T,), by name."""

    @property
    def largest_impulse_n_s(self) -> float:
        """Largest impulse of a single contact [N s]; 0 without contacts."""
        sizes = [np.linalg.norm(rows["impulse_world"], axis=-1) for rows in self.contacts if len(rows["mode"])]
        return max((float(values.max()) for values in sizes), default=0.0)


def recorded_motion(reader: RolloutReader, number: int) -> Motion:
    """Return the rollout at index `number` of a reader; its pictures are read on demand."""
    frames = reader.rollouts[number].frames
    return Motion(
        times_s=reader.read(number, "time"),
        position_m=reader.read(number, "bodies/pos"),
        quat_wxyz=reader.read(number, "bodies/quat_wxyz"),
        contacts=tuple(reader.contacts(number, frame) for frame in range(frames)),
        cameras={name: reader.camera(number, name) for name in reader.cameras(number)},
        image=lambda name, frame: reader.read(number, f"obs/{name}_image", frame, frame + 1)[0],
        joints=_recorded_joints(reader, number),
    )


def _recorded_joints(reader: RolloutReader, number: int) -> dict[str, Array]:
    if "joints" not in reader.group(number):
        return {}
    names, values = reader.read(number, "joints/names"), reader.read(number, "joints/pos")
    return {name.decode("utf-8", "replace"): values[:, k] for k, name in enumerate(names.tolist())}


def still(model: Model) -> Motion:
    """Return the model with its bodies as in the photos, joints in the middle of their limits or at 0: one frame."""
    poses = [body.photo_pose for body in model.file.bodies]
    position = np.array([pose.position_m for pose in poses], np.float64)
    quat = np.array([pose.quat_wxyz for pose in poses], np.float64)
    joints = [JointedStart.of(one, middle) for one in model.file.articulations]
    put_links(
        (position, quat, np.zeros_like(position), np.zeros_like(position)), [b.name for b in model.file.bodies], joints
    )
    return Motion(
        times_s=np.zeros(1),
        position_m=position[None],
        quat_wxyz=quat[None],
        contacts=(_no_contacts(),),
        joints={name: one.values[k : k + 1] for one in joints for k, name in enumerate(one.chain.joint_names)},
    )


def replayed(found: Replay) -> Motion:
    """Return a motion that was recorded elsewhere."""
    contacts: list[Contacts] = [_no_contacts() for _ in found.times_s]
    place, impulse = found.contact_m, found.impulse_n_s
    if place is not None and impulse is not None:
        for frame in np.flatnonzero(np.linalg.norm(impulse, axis=-1) > 0):
            one = {"pos_world": place[[frame]], "impulse_world": impulse[[frame]], "mode": np.zeros(1, np.uint8)}
            contacts[frame] = one
    return Motion(
        times_s=found.times_s,
        position_m=found.position_m,
        quat_wxyz=found.quat_wxyz,
        contacts=tuple(contacts),
        contacts_known=impulse is not None,
    )


def can_move(model: Model) -> bool:
    """Return whether a model can be simulated: it has fitted contacts, collision spheres and what physics moves."""
    bodies = model.file.bodies
    spheres = all(body.name in model.collision for body in bodies)
    driven = any(one.base == "driven" for one in model.file.articulations)
    return model.file.contact is not None and spheres and bool(model.file.tracked) and not driven


def own_motion(model: Model, number: int) -> Motion:
    """Simulate a rollout that `cgwm synthesize` draws by default, with every parameter at its estimate.

    Args:
        model: A model that can move.
        number: Global index of the rollout, at seed 0.

    Raises:
        NotConvergedError: If the simulation diverges.
    """
    config = SynthesizeConfig(plan=resolve_plan(model, SamplingPlan(parameter_spread=0.0)))
    times_s = np.arange(round(config.duration_s * config.frame_rate_hz) + 1) / config.frame_rate_hz
    drawn = draw_rollout(model, config.plan, config, {}, float(times_s[-1]), number)
    (found,) = Simulator(model, times_s, "cpu").run([drawn], config.seed)
    if isinstance(found, Diverged):
        raise found.error
    poses = (found.position_m, found.quat_wxyz, found.velocity_m_s, found.omega_body_rad_s)
    table = joint_table(model.file, poses)
    return Motion(
        times_s=times_s,
        position_m=found.position_m,
        quat_wxyz=found.quat_wxyz,
        contacts=_by_frame(found.contacts),
        joints={} if table is None else dict(zip(table.names, table.values.T, strict=True)),
    )


def _by_frame(table: ContactTable) -> tuple[Contacts, ...]:
    columns = {"pos_world": table.position_m, "impulse_world": table.impulse_n_s, "mode": table.sliding}
    return tuple(
        {name: values[first:last] for name, values in columns.items()} for first, last in pairwise(table.offsets)
    )


def _no_contacts() -> Contacts:
    return {"pos_world": np.zeros((0, 3)), "impulse_world": np.zeros((0, 3)), "mode": np.zeros(0, np.uint8)}
