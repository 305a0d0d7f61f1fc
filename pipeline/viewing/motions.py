"""The motions that can be looked at: rollouts of a dataset, and what a model does by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.cameras import Camera
from ...datasets.loader import RolloutReader
from ...datasets.models import Model
from ...schemas import SamplingPlan, SynthesizeConfig
from ..physics.checks import require_apart, require_finite
from ..physics.dispatch import rollout as roll_out
from ..physics.records import ContactRecord
from ..physics.world import State, World
from ..posterior import draw_parameters
from ..sampling import draw_start, resolve_plan

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
    config = SynthesizeConfig()
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(number,)))
    file, _ = draw_parameters(model.file, 0.0, rng)  # draws the numbers that the start's follow
    model = replace(model, file=file)
    times_s = np.arange(round(config.duration_s * config.frame_rate_hz) + 1) / config.frame_rate_hz
    start = draw_start(model, resolve_plan(model, SamplingPlan()), float(times_s[-1]), rng)
    world = World.from_model(model)
    values = (start.position_m, start.quat_wxyz, start.velocity_m_s, start.omega_body_rad_s)
    state = State(*(torch.as_tensor(value, dtype=torch.float64)[None] for value in values))
    require_apart(world, state)
    with torch.no_grad():
        rollout = roll_out(world, state, torch.as_tensor(times_s), start.driven, record_contacts=True)
    require_finite(rollout, world, state, [f"rollout {number}"])
    assert rollout.contacts is not None  # asked for above
    return Motion(times_s, rollout.position_m[0].numpy(), rollout.quat_wxyz[0].numpy(), _rows(rollout.contacts))


def _rows(record: ContactRecord) -> tuple[Contacts, ...]:
    """Return the contacts that touch at a frame, or passed on an impulse since the frame before, by frame."""
    position, impulse = record.position_m[0].numpy(), record.impulse_n_s[0].numpy()
    active = (np.abs(impulse).max(-1) > 0) | (record.distance_m[0].numpy() <= 0)
    sliding = record.sliding[0].numpy().astype(np.uint8)
    return tuple(
        {"pos_world": place[here], "impulse_world": push[here], "mode": mode[here]}
        for place, push, mode, here in zip(position, impulse, sliding, active, strict=True)
    )


def _no_contacts() -> Contacts:
    return {"pos_world": np.zeros((0, 3)), "impulse_world": np.zeros((0, 3)), "mode": np.zeros(0, np.uint8)}
