"""Comparison of MuJoCo's simulation of an exported model with a rollout by our engine."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from ...datasets.capture.tracks import Track
from ...datasets.models.mjcf import Keyframe
from ...datasets.models.model import Model
from ...datasets.shapes.interpolation import by_column
from ...schemas import SamplingPlan
from ..physics.model_world import world_of_model
from ..physics.rollout import require_finite, simulate
from ..physics.state import State
from ..synthesize.plan import resolve_plan
from ..synthesize.start_states import Start, draw_start

mujoco: Any = importlib.import_module("mujoco")  # it has no type stubs, so a checker knows none of its names

FRAME_S = 0.01
"""Time between the compared frames [s]."""
AFTER_CONTACT_S = 0.1
"""Length of the compared motion after the first contact [s]."""


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """Largest deviations of MuJoCo from our engine over the free bodies; None for a missing part of the motion."""

    duration_s: float
    """Length of the rollout [s]."""
    first_contact_s: float | None
    """Time of the first contact in our engine [s]; None without contact."""
    flight: tuple[float, float] | None
    """Largest deviation of position [mm] and rotation [deg] before the first contact."""
    impact: tuple[float, float] | None
    """Largest deviation from the first contact to `AFTER_CONTACT_S` after it, same units."""
    end: tuple[float, float]
    """Deviation in the last frame, same units."""


def start_of(model: Model, seed: int, duration_s: float) -> Start:
    """Draw the start that `cgwm synthesize` would draw for its rollout 0, with parameters at their estimates."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    return draw_start(model, resolve_plan(model, SamplingPlan()), duration_s, rng)


def keyframe_of(start: Start) -> Keyframe:
    """Return a start as a keyframe of MJCF."""
    return Keyframe(
        name="start",
        position_m=start.position_m,
        quat_wxyz=start.quat_wxyz,
        velocity_m_s=start.velocity_m_s,
        omega_body_rad_s=start.omega_body_rad_s,
    )


def resimulate(model: Model, mjcf: str, start: Start, duration_s: float) -> Deviation:
    """Roll out a model in our engine and its MJCF in MuJoCo, both from the keyframe `start`, and compare.

    Args:
        model: The model.
        mjcf: MJCF of the model, with a keyframe of that start. Its time step is reduced to the next divisor of
            `FRAME_S`.
        start: Common start of both simulations.
        duration_s: Length [s], rounded to whole frames of `FRAME_S`.

    Raises:
        NotConvergedError: If our rollout diverges.
    """
    times = np.arange(round(duration_s / FRAME_S) + 1) * FRAME_S
    world = world_of_model(model, torch.float64)
    parts = (start.position_m, start.quat_wxyz, start.velocity_m_s, start.omega_body_rad_s)
    state = State(*(torch.as_tensor(part, dtype=torch.float64)[None] for part in parts))
    with torch.no_grad():
        ours = simulate(world, state, torch.as_tensor(times), start.driven, record_contacts=True)
    require_finite(ours, world, state, ["the rollout to compare with"])
    free = [k for k, body in enumerate(model.file.bodies) if body.motion == "free"]
    theirs = _mujoco_poses(model, mjcf, start.driven, times, [model.file.bodies[k].name for k in free])
    away = ours.position_m[0, :, free].numpy() - theirs[0]
    position_mm = 1e3 * np.linalg.norm(away, axis=-1).max(1)
    cosine = np.abs((ours.quat_wxyz[0, :, free].numpy() * theirs[1]).sum(-1)).clip(0, 1)
    rotation_deg = np.degrees(2 * np.arccos(cosine)).max(1)
    assert ours.contacts is not None  # asked for above
    touching = np.flatnonzero((ours.contacts.impulse_n_s[0].numpy() != 0).any((1, 2)))
    first = int(touching[0]) if len(touching) else None
    last = len(times) if first is None else first + round(AFTER_CONTACT_S / FRAME_S)

    def largest(part: slice) -> tuple[float, float]:
        return float(position_mm[part].max()), float(rotation_deg[part].max())

    return Deviation(
        duration_s=float(times[-1]),
        first_contact_s=None if first is None else float(times[first]),
        flight=largest(slice(0, first)) if first != 0 else None,
        impact=None if first is None else largest(slice(first, last + 1)),
        end=(float(position_mm[-1]), float(rotation_deg[-1])),
    )


def link_deviation(model: Model, mjcf: str, seed: int) -> tuple[float, float]:
    """Return how far links of jointed bodies are in MuJoCo from where they are here, at random values of the joints.

    Returns:
        The largest distance of their origins [mm], and the largest angle between them [deg].
    """
    rng, world = np.random.default_rng(seed), world_of_model(model, torch.float64)
    loaded = mujoco.MjModel.from_xml_string(mjcf)
    data = mujoco.MjData(loaded)
    expected = {}
    for chain in world.chains:
        place = model.body(chain.root).photo_pose
        position, quat = np.array(place.position_m), np.array(place.quat_wxyz)
        if chain.base == "free":
            position, quat = rng.normal(size=3), rng.normal(size=4)
            quat /= np.linalg.norm(quat)
            data.joint(f"{chain.root}_free").qpos[:] = (*position, *quat)
        low, high = (chain.numbers(name)[0].numpy() for name in ("lower", "upper"))
        values = rng.uniform(low.clip(-1.0), high.clip(max=1.0))
        for name, value in zip(chain.joint_names, values, strict=True):
            data.joint(name).qpos[0] = value
        rows = [torch.as_tensor(row)[None] for row in (position, quat, values)]
        poses = [x[0].numpy() for x in chain.poses(rows[0], rows[1], rows[2])]
        expected |= {name: (poses[0][k], poses[1][k]) for k, name in enumerate(chain.links)}
    mujoco.mj_kinematics(loaded, data)
    moved = [np.linalg.norm(data.body(name).xpos - place) for name, (place, _) in expected.items()]
    turns = [np.abs(data.body(name).xquat @ quat).clip(0, 1) for name, (_, quat) in expected.items()]
    return 1e3 * float(max(moved)), float(np.degrees(2 * np.arccos(min(turns))))


def _mujoco_poses(
    model: Model, mjcf: str, driven: dict[str, Track], times_s: np.ndarray, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [m] (T, F, 3) and quaternions (T, F, 4) of the bodies `names` in MuJoCo."""
    loaded = mujoco.MjModel.from_xml_string(mjcf)
    steps = int(np.ceil(FRAME_S / loaded.opt.timestep - 1e-9))
    loaded.opt.timestep = FRAME_S / steps
    data = mujoco.MjData(loaded)
    mujoco.mj_resetDataKeyframe(loaded, data, loaded.key("start").id)
    mujoco.mj_forward(loaded, data)
    frames = [_poses(data, names)]
    for _ in times_s[1:]:
        for _ in range(steps):
            for body, track in driven.items():
                mocap = int(loaded.body(body).mocapid[0])
                # the command at the end of the step, because the step's contacts are solved for that position
                pose = _commanded(track, data.time + loaded.opt.timestep)
                data.mocap_pos[mocap], data.mocap_quat[mocap] = pose
            mujoco.mj_step(loaded, data)
        frames.append(_poses(data, names))
    position, quat = zip(*frames, strict=True)
    return np.array(position), np.array(quat)


def _commanded(track: Track, time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and quaternion w x y z (4,) of a command at a time; constant outside its time range."""
    now = np.clip(time_s, track.time_s[0], track.time_s[-1])
    position = by_column(now, track.time_s, track.position_m)
    assert track.quat_wxyz is not None  # sampled commands have orientations
    turns = Slerp(track.time_s, Rotation.from_quat(track.quat_wxyz, scalar_first=True))
    return position, turns(now).as_quat(scalar_first=True)


def _poses(data: Any, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    joints = [data.joint(f"{name}_free").qpos for name in names]
    return np.array([joint[:3] for joint in joints]), np.array([joint[3:] for joint in joints])
