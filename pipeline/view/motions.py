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
from ...datasets.rollouts.rollouts import ContactTable
from ...schemas import SamplingPlan, SynthesizeConfig
from ..synthesize.draw import draw_rollout
from ..synthesize.plan import resolve_plan
from ..synthesize.simulator import Diverged, Simulator

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
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    """Cameras of its pictures, by name."""
    image: Callable[[str, int], NDArray[np.uint8]] | None = None
    """Function that returns the picture of a camera at a frame, uint8 RGB (H, W, 3); None without cameras."""

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
    )


def still(model: Model) -> Motion:
    """Return the model with its bodies as in the photos: one frame, no contacts."""
    poses = [body.photo_pose for body in model.file.bodies]
    return Motion(
        times_s=np.zeros(1),
        position_m=np.array([[pose.position_m for pose in poses]], np.float64),
        quat_wxyz=np.array([[pose.quat_wxyz for pose in poses]], np.float64),
        contacts=(_no_contacts(),),
    )


def can_move(model: Model) -> bool:
    """Return whether a model can be simulated: it has fitted contacts, collision spheres and a free body."""
    bodies = model.file.bodies
    spheres = all(body.name in model.collision for body in bodies)
    return model.file.contact is not None and spheres and any(body.motion == "free" for body in bodies)


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
    return Motion(
        times_s=times_s, position_m=found.position_m, quat_wxyz=found.quat_wxyz, contacts=_by_frame(found.contacts)
    )


def _by_frame(table: ContactTable) -> tuple[Contacts, ...]:
    columns = {"pos_world": table.position_m, "impulse_world": table.impulse_n_s, "mode": table.sliding}
    return tuple(
        {name: values[first:last] for name, values in columns.items()} for first, last in pairwise(table.offsets)
    )


def _no_contacts() -> Contacts:
    return {"pos_world": np.zeros((0, 3)), "impulse_world": np.zeros((0, 3)), "mode": np.zeros(0, np.uint8)}
