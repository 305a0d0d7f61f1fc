"""Arrays of one rollout in HDF5 except its images, each with unit, frame, order, shape and description."""

from __future__ import annotations

import json
from collections.abc import Mapping

import h5py
import numpy as np

from ...schemas import Exposure
from ..capture.cameras import Camera
from .array_table import turning
from .described import new_group, put, write_number, write_text
from .rollouts import ContactTable, JointTable, Node, RolloutLabels, RolloutParameter


def write_tables(demo: Node, labels: RolloutLabels) -> Node:
    """Write everything of a rollout except its images into its group, and return the group of observations."""
    _write_attributes(demo, labels, len(labels.time_s))
    _write_timeline(demo, labels)
    _write_bodies(demo, labels)
    if labels.joints is not None:
        _write_joints(demo, labels.joints)
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
    put(demo, "time", labels.time_s)
    put(demo, "states", labels.states)
    put(demo, "actions", labels.actions, action_meaning=labels.action_meaning)
    put(demo, "rewards", np.zeros(count))
    put(demo, "dones", done)


def _write_bodies(demo: Node, labels: RolloutLabels) -> None:
    group = new_group(demo, "bodies")
    put(group, "bodies/names", np.array([name.encode() for name in labels.bodies]))
    put(group, "bodies/motions", np.array([motion.encode() for motion in labels.motions]))
    if labels.materials is not None:
        put(group, "bodies/materials", np.array([(name or "").encode() for name in labels.materials], "S"))
    put(group, "bodies/pos", labels.position_m)
    put(group, "bodies/quat_wxyz", labels.quat_wxyz)
    put(group, "bodies/vel", labels.velocity_m_s)
    put(group, "bodies/omega_body", labels.omega_body_rad_s)
    put(group, "bodies/contact_force", labels.contact_force_n)
    put(group, "bodies/contact_torque", labels.contact_torque_n_m, turning=turning(labels.effects))
    put(group, "bodies/mass", labels.mass_kg)
    put(group, "bodies/com", labels.com_m)
    put(group, "bodies/inertia", labels.inertia_kg_m2)
    put(group, "bodies/gravity", labels.gravity_m_s2)


def _write_joints(demo: Node, joints: JointTable) -> None:
    group = new_group(demo, "joints")
    for name, texts in (("names", joints.names), ("links", joints.links), ("kinds", joints.kinds)):
        put(group, f"joints/{name}", np.array([text.encode() for text in texts]))
    put(group, "joints/pos", joints.values)
    put(group, "joints/vel", joints.speeds)


def _write_contacts(demo: Node, labels: RolloutLabels) -> None:
    table, group = labels.contacts, new_group(demo, "contacts")
    put(group, "contacts/offsets", table.offsets)
    put(group, "contacts/body_a", table.body_a)
    put(group, "contacts/body_b", table.body_b)
    put(group, "contacts/pos_world", table.position_m)
    put(group, "contacts/normal_world", table.normal)
    put(group, "contacts/distance", table.distance_m)
    put(group, "contacts/impulse_world", table.impulse_n_s)
    put(group, "contacts/force_world", _forces(table, labels.time_s))
    put(group, "contacts/mode", table.sliding)


def _forces(table: ContactTable, time_s: np.ndarray) -> np.ndarray:
    frame = np.repeat(np.arange(len(time_s)), np.diff(table.offsets))
    length = np.concatenate([[np.inf], np.diff(time_s)])
    return table.impulse_n_s / length[frame][:, None]


def _write_parameters(demo: Node, parameters: tuple[RolloutParameter, ...]) -> None:
    group = new_group(demo, "parameters")
    for p in parameters:
        made = put(group, "parameters/{parameter}", np.float64(p.value), parameter=p.name, unit=p.unit)
        for key, value in (("estimate", p.estimate), ("std_error", p.std_error)):
            if value is not None:
                write_number(made, key, np.float64(value))


def _write_object_observation(group: Node, labels: RolloutLabels) -> None:
    parts = (labels.position_m, labels.quat_wxyz, labels.velocity_m_s, labels.omega_body_rad_s)
    put(group, "obs/object", np.concatenate(parts, axis=-1).reshape(len(labels.time_s), -1))


def _write_cameras(demo: Node, cameras: Mapping[str, Camera], exposures: Mapping[str, Exposure]) -> None:
    group = new_group(demo, "cameras")
    for name, camera in cameras.items():
        entry = new_group(group, name)
        distortion, exposure = np.asarray(camera.distortion, float), exposures.get(name, Exposure())
        put(entry, "cameras/{camera}/K", camera.K)
        put(entry, "cameras/{camera}/dist", distortion)
        put(entry, "cameras/{camera}/T_world_cam", camera.T_world_cam)
        put(entry, "cameras/{camera}/width", camera.width)
        put(entry, "cameras/{camera}/height", camera.height)
        put(entry, "cameras/{camera}/gain_rgb", exposure.gain_rgb)
        put(entry, "cameras/{camera}/offset_rgb", exposure.offset_rgb)
        write_text(entry.id, b"camera_model", "OPENCV" if distortion.any() else "PINHOLE")


def _write_light(demo: Node, labels: RolloutLabels) -> None:
    """The rollout's light; its gain is part of every camera's `gain_rgb`."""
    group = new_group(demo, "light")
    put(group, "light/gain_rgb", np.ones(3) if labels.light_gain_rgb is None else labels.light_gain_rgb)
    if labels.light is not None:
        put(group, "light/lamp", labels.light.lamp)
        put(group, "light/sky", labels.light.sky)


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
