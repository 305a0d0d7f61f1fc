"""Arrays of one rollout in HDF5 except its images, each with unit, frame, order, shape and description."""

from __future__ import annotations

import json
from collections.abc import Mapping

import h5py
import numpy as np

from ...schemas import Exposure
from ..capture.cameras import Camera
from .described import new_group, put, write_number, write_text
from .rollouts import ContactTable, Node, RolloutLabels, RolloutParameter

TORQUE = "Mean torque on free bodies about the centre of mass since the frame before, from the angular momentum"


def write_tables(demo: Node, labels: RolloutLabels) -> Node:
    """Write everything of a rollout except its images into its group, and return the group of observations."""
    _write_attributes(demo, labels, len(labels.time_s))
    _write_timeline(demo, labels)
    _write_bodies(demo, labels)
    _write_contacts(demo, labels)
    _write_parameters(demo, labels.parameters)
    observations = new_group(demo, "obs")
    _write_object_observation(observations, labels)
    if labels.cameras:
        _write_cameras(demo, labels.cameras, labels.exposures or {})
        _write_light(demo, labels)
    return observations


def _write_attributes(demo: Node, labels: RolloutLabels, count: int) -> None:
    parameters = {p.name: {"value": p.value, "unit": p.unit} for p in labels.parameters}
    numbers = {"num_samples": count, "episode_index": labels.episode_index, "seed": labels.seed}
    for name, number in {**numbers, "attempt": labels.attempt}.items():
        write_number(demo.id, name, np.int64(number))
    texts = {
        b"model_file": labels.model_mjcf,
        b"params_json": json.dumps(parameters),
        b"effects_json": json.dumps({name: dict(values) for name, values in (labels.effects or {}).items()}),
    }
    for name, text in texts.items():
        write_text(demo.id, name, text)


def _write_timeline(demo: Node, labels: RolloutLabels) -> None:
    count = len(labels.time_s)
    done = np.zeros(count, np.uint8)
    done[-1] = 1
    state_text = "MuJoCo's state of the attribute model_file (free bodies; velocities linear world, angular body)."
    put(demo, "time", labels.time_s, "s", "-", "-", "(T,)", "Time since the rollout's start.")
    put(demo, "states", labels.states, "SI", "world", "time, qpos, qvel; quaternions w x y z", "(T, D)", state_text)
    put(demo, "actions", labels.actions, "1", "world", "x y z a driven body", "(T, A)", labels.action_meaning)
    put(demo, "rewards", np.zeros(count), "1", "-", "-", "(T,)", "No task is defined: zero.")
    put(demo, "dones", done, "1", "-", "-", "(T,)", "1 at the last frame.")


def _write_bodies(demo: Node, labels: RolloutLabels) -> None:
    group = new_group(demo, "bodies")
    names = np.array([name.encode() for name in labels.bodies])
    motions = np.array([motion.encode() for motion in labels.motions])
    inertia_text = "About the centre of mass, body axes."
    put(group, "names", names, "-", "-", "-", "(B,)", "Body k has the value k + 1 in the masks.")
    put(group, "motions", motions, "-", "-", "-", "(B,)", "free, driven (its track is a command) or fixed.")
    put(group, "pos", labels.position_m, "m", "world", "x y z", "(T, B, 3)", "Origin of the body frame.")
    put(group, "quat_wxyz", labels.quat_wxyz, "1", "world", "w x y z", "(T, B, 4)", "Rotation of T_world_body.")
    put(group, "vel", labels.velocity_m_s, "m/s", "world", "x y z", "(T, B, 3)", "Velocity of the body origin.")
    put(group, "omega_body", labels.omega_body_rad_s, "rad/s", "body", "x y z", "(T, B, 3)", "Angular velocity.")
    torque = f"{TORQUE} ({_turning(labels)}); 0 at frame 0 and for other bodies."
    force = "Mean force of all contacts on the body since the frame before; 0 at frame 0."
    put(group, "contact_force", labels.contact_force_n, "N", "world", "x y z", "(T, B, 3)", force)
    put(group, "contact_torque", labels.contact_torque_n_m, "N m", "world", "x y z", "(T, B, 3)", torque)
    put(group, "mass", labels.mass_kg, "kg", "-", "-", "(B,)", "Mass in this rollout.")
    put(group, "com", labels.com_m, "m", "body", "x y z", "(B, 3)", "Centre of mass in the body frame.")
    put(group, "inertia", labels.inertia_kg_m2, "kg m2", "body", "xx yy zz xy xz yz", "(B, 6)", inertia_text)
    put(group, "gravity", labels.gravity_m_s2, "m/s2", "world", "x y z", "(3,)", "Gravitational acceleration.")


def _turning(labels: RolloutLabels) -> str:
    names = ", ".join(labels.effects or ())
    return f"contacts, and what the effects {names} add" if names else "contacts alone turn them"


def _write_contacts(demo: Node, labels: RolloutLabels) -> None:
    table, group = labels.contacts, new_group(demo, "contacts")
    impulse = "Impulse on body a since the frame before (frame 0: zero); body b gets its opposite."
    force = "Mean force on body a since the frame before (frame 0: zero): the impulse over the time between the frames."
    offsets = "Rows offsets[t]:offsets[t + 1] of the other arrays belong to frame t."
    mode = "0 = sticking, 1 = sliding (friction at its limit)."
    put(group, "offsets", table.offsets, "1", "-", "-", "(T + 1,)", offsets)
    put(group, "body_a", table.body_a, "1", "-", "-", "(N,)", "Index into bodies/names.")
    put(group, "body_b", table.body_b, "1", "-", "-", "(N,)", "Index into bodies/names; -1 = the ground.")
    put(group, "pos_world", table.position_m, "m", "world", "x y z", "(N, 3)", "Contact point.")
    put(group, "normal_world", table.normal, "1", "world", "x y z", "(N, 3)", "Unit normal from b to a.")
    put(group, "distance", table.distance_m, "m", "-", "-", "(N,)", "Signed distance; negative = penetration.")
    put(group, "impulse_world", table.impulse_n_s, "N s", "world", "x y z", "(N, 3)", impulse)
    put(group, "force_world", _forces(table, labels.time_s), "N", "world", "x y z", "(N, 3)", force)
    put(group, "mode", table.sliding, "1", "-", "-", "(N,)", mode)


def _forces(table: ContactTable, time_s: np.ndarray) -> np.ndarray:
    frame = np.repeat(np.arange(len(time_s)), np.diff(table.offsets))
    length = np.concatenate([[np.inf], np.diff(time_s)])
    return table.impulse_n_s / length[frame][:, None]


def _write_parameters(demo: Node, parameters: tuple[RolloutParameter, ...]) -> None:
    group = new_group(demo, "parameters")
    for p in parameters:
        made = put(group, p.name, np.float64(p.value), p.unit, "-", "-", "scalar", "Value used in this rollout.")
        for key, value in (("estimate", p.estimate), ("std_error", p.std_error)):
            if value is not None:
                write_number(made, key, np.float64(value))


def _write_object_observation(group: Node, labels: RolloutLabels) -> None:
    parts = (labels.position_m, labels.quat_wxyz, labels.velocity_m_s, labels.omega_body_rad_s)
    values = np.concatenate(parts, axis=-1).reshape(len(labels.time_s), -1)
    order = "for each body: position, quaternion w x y z, velocity (world), angular velocity (body)"
    put(group, "object", values, "SI", "world", order, "(T, 13 B)", "State of all bodies, robomimic's low-dim key.")


def _write_cameras(demo: Node, cameras: Mapping[str, Camera], exposures: Mapping[str, Exposure]) -> None:
    group = new_group(demo, "cameras")
    for name, camera in cameras.items():
        entry = new_group(group, name)
        distortion = np.asarray(camera.distortion, float)
        text = "Camera to world; OpenCV axes (x right, y down, z forward)."
        put(entry, "K", camera.K, "px", "image", "row", "(3, 3)", "Intrinsics; top-left pixel centre (0.5, 0.5).")
        put(entry, "dist", distortion, "1", "-", "k1 k2 p1 p2 k3", "(k,)", "OpenCV distortion; empty: none.")
        put(entry, "T_world_cam", camera.T_world_cam, "m", "world", "row", "(4, 4)", text)
        put(entry, "width", camera.width, "px", "-", "-", "scalar", "Image width.")
        put(entry, "height", camera.height, "px", "-", "-", "scalar", "Image height.")
        exposure = exposures.get(name, Exposure())
        seen = "What the model shows, 0 to 1, times this, plus offset_rgb, cut off at 0 and 1, is the image."
        put(entry, "gain_rgb", exposure.gain_rgb, "1", "-", "RGB", "(3,)", f"Exposure and light. {seen}")
        put(entry, "offset_rgb", exposure.offset_rgb, "1", "-", "RGB", "(3,)", "Exposure: see gain_rgb.")
        write_text(entry.id, b"camera_model", "OPENCV" if distortion.any() else "PINHOLE")


def _write_light(demo: Node, labels: RolloutLabels) -> None:
    """The rollout's light; its gain is part of every camera's `gain_rgb`."""
    group = new_group(demo, "light")
    gain = np.ones(3) if labels.light_gain_rgb is None else labels.light_gain_rgb
    put(group, "gain_rgb", gain, "1", "-", "RGB", "(3,)", "Brightness relative to the photos; in the cameras' gain.")
    if labels.light is not None:
        text = "Direction to the lamp times its brightness relative to the room's mean; shades the moving bodies."
        put(group, "lamp", labels.light.lamp, "1", "world", "x y z", "(3,)", text)
        put(group, "sky", labels.light.sky, "1", "world", "-", "scalar", "Brightness from above against the side.")


def link_next_observations(demo: Node, observations: Node) -> None:
    """Add `next_obs` as virtual datasets on `obs`, shifted by one frame: what robomimic reads, at no size."""
    group = new_group(demo, "next_obs")
    place = observations.name
    for name in observations:
        source = h5py.h5d.open(observations.id, name.encode())
        shape, path = source.shape, f"{place}/{name}".encode()
        # By h5py's low level: its high level stamps virtual datasets with the time of their creation.
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_obj_track_times(False)
        properties.set_layout(h5py.h5d.VIRTUAL)
        for target, start, length in ((0, 1, shape[0] - 1), (shape[0] - 1, shape[0] - 1, 1)):
            if length > 0:
                spaces = [_frames_space(shape, first, length) for first in (target, start)]
                properties.set_virtual(spaces[0], b".", path, spaces[1])
        space = h5py.h5s.create_simple(shape)
        made = h5py.h5d.create(group.id, name.encode(), source.get_type(), space, properties)
        write_text(made, b"description", f"obs/{name} one frame later; the last frame is repeated.")


def _frames_space(shape: tuple[int, ...], first: int, length: int) -> h5py.h5s.SpaceID:
    space = h5py.h5s.create_simple(shape)
    space.select_hyperslab((first, *(0 for _ in shape[1:])), (length, *shape[1:]))
    return space
