"""The motions that can be looked at: rollouts of a dataset, and what a model does by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...datasets.cameras import Camera
from ...datasets.loader import RolloutReader
from ...datasets.models import Model
from ...datasets.rollouts import ContactTable
from ...schemas import SamplingPlan, SynthesizeConfig
from ..draws import draw_rollout
from ..rollout_batches import Diverged, Simulator
from ..sampling import resolve_plan

Array = NDArray[np.float64]
Contacts = Mapping[str, NDArray[np.generic]]
"""Of one frame: pos_world [m] (N, 3), impulse_world [N s] (N, 3), mode (N,), as `RolloutReader.contacts` has them."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of all bodies of a model. T frames, B bodies.

    Attributes:
        times_s: Shape (T,).
        position_m: Body frame origins [m], world, shape (T, B, 3).
        quat_wxyz: T_world_body, shape (T, B, 4).
        contacts: Of each frame.
        cameras: That filmed it, by name.
        image: Returns the picture, uint8 RGB (H, W, 3), of a camera at a frame; None where there are no cameras.
    """

    times_s: Array
    position_m: Array
    quat_wxyz: Array
    contacts: tuple[Contacts, ...]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    image: Callable[[str, int], NDArray[np.uint8]] | None = None

    @property
    def largest_impulse_n_s(self) -> float:
        """The largest impulse of a single contact [N s]; 0 without contacts."""
        sizes = [np.linalg.norm(rows["impulse_world"], axis=-1) for rows in self.contacts if len(rows["mode"])]
        return max((float(values.max()) for values in sizes), default=0.0)


def recorded_motion(reader: RolloutReader, number: int) -> Motion:
    """Return the rollout at place `number` of a reader; its pictures are read when they are asked for."""
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
    """Return the model as it stood in the photos: one frame, no contacts."""
    poses = [body.photo_pose for body in model.file.bodies]
    return Motion(
        times_s=np.zeros(1),
        position_m=np.array([[pose.position_m for pose in poses]], np.float64),
        quat_wxyz=np.array([[pose.quat_wxyz for pose in poses]], np.float64),
        contacts=(_no_contacts(),),
    )


def can_move(model: Model) -> bool:
    """Tell whether a model has what a simulation needs: fitted contacts, colliding spheres, and a free body."""
    bodies = model.file.bodies
    spheres = all(body.name in model.collision for body in bodies)
    return model.file.contact is not None and spheres and any(body.motion == "free" for body in bodies)


def own_motion(model: Model, number: int) -> Motion:
    """Simulate what `cgwm synthesize` draws first by default, with every parameter at its estimate.

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
    return Motion(times_s, found.position_m, found.quat_wxyz, _by_frame(found.contacts))


def _by_frame(table: ContactTable) -> tuple[Contacts, ...]:
    columns = {"pos_world": table.position_m, "impulse_world": table.impulse_n_s, "mode": table.sliding}
    return tuple(
        {name: values[first:last] for name, values in columns.items()} for first, last in pairwise(table.offsets)
    )


def _no_contacts() -> Contacts:
    return {"pos_world": np.zeros((0, 3)), "impulse_world": np.zeros((0, 3)), "mode": np.zeros(0, np.uint8)}
