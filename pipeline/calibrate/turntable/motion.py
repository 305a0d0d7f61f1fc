"""The motion of a camera about a turntable: it stands at a few places, and what it shows turns about one axis.

In the frame of what turns, cameras are then T_cam_world = T_cam_axis Rz(angle): one pose for each place of the camera
(a ring of photos) and one angle for each photo, instead of six numbers for each photo.
"""

from __future__ import annotations

from collections.abc import Mapping as Map
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..bundle import POSE
from ..reconstruction import Array, SfmModel, Similarity

LEAST_RING = 5
"""Least number of photos of a ring; other photos have poses of their own."""
_LEAST_IN_RINGS = 0.8
"""Least share of the photos that rings hold."""
_TURN_DEG = (15.0, 165.0)
"""Angles between two photos of a ring whose axis is well known."""
_AXES_DEG = 4.0
"""Angle between two axes that count as one."""
_ALIKE = 0.2
"""Largest difference of poses of one ring: rotation [rad] and place [radius of the ring]."""
_REFINED = 20


@dataclass(frozen=True)
class TurntableMotion:
    """Rings of photos about the z axis of the world."""

    rings: tuple[tuple[str, ...], ...]
    """Names of the photos of each ring; a photo with a pose of its own is a ring of one."""
    T_cam_axis: tuple[Array, ...]
    """Pose (4, 4) of the camera of each ring, when what turns has turned by 0."""
    angles: Map[str, float]
    """By how much it has turned in each photo [rad]."""

    def poses(self) -> dict[str, Array]:
        """Return the pose (4, 4) of each photo, world to camera."""
        return {
            image: standing @ about_z(self.angles[image])
            for ring, standing in zip(self.rings, self.T_cam_axis, strict=True)
            for image in ring
        }

    def placed(self, model: SfmModel) -> SfmModel:
        """Return a model with the poses of the motion, in the order that it has."""
        poses = self.poses()
        return replace(model, T_cam_world={image: poses[image] for image in model.T_cam_world})

    def design(self, names: list[str], lenses: int) -> Array:
        """Return how poses and intrinsics change with the numbers of the motion, shape (6 photos + lenses, n).

        The numbers are, ring after ring, the six of its pose and the angles of all its photos but the first; then
        those of the intrinsics.

        Args:
            names: The photos in the order of the rows.
            lenses: Number of free numbers of the intrinsics.
        """
        row = {image: POSE * k for k, image in enumerate(names)}
        poses, size = self.poses(), POSE * len(names) + lenses
        parts = []
        for ring in self.rings:
            part = np.zeros((size, POSE + len(ring) - 1))
            for k, image in enumerate(ring):
                turn, pose, at = about_z(self.angles[image])[:3, :3], poses[image], row[image]
                part[at : at + 3, :3], part[at + 3 : at + 6, 3:6] = turn.T, np.eye(3)
                if k:  # turning by da moves the centre by -z x c da, and the camera by R z da
                    center = -pose[:3, :3].T @ pose[:3, 3]
                    part[at : at + 3, POSE + k - 1] = -np.cross([0.0, 0.0, 1.0], center)
                    part[at + 3 : at + 6, POSE + k - 1] = pose[:3, 2]
            parts.append(part)
        last = np.zeros((size, lenses))
        last[size - lenses :] = np.eye(lenses)
        return np.concatenate([*parts, last], axis=1)

    def moved(self, step: Array) -> TurntableMotion:
        """Return the motion after a step of its numbers, in the order of `design`."""
        standing, angles, at = [], dict(self.angles), 0
        for ring, pose in zip(self.rings, self.T_cam_axis, strict=True):
            rotation = Rotation.from_rotvec(step[at + 3 : at + 6]).as_matrix() @ pose[:3, :3]
            center = -pose[:3, :3].T @ pose[:3, 3] + step[at : at + 3]
            standing.append(_pose(rotation, center))
            for k, image in enumerate(ring[1:]):
                angles[image] += float(step[at + POSE + k])
            at += POSE + len(ring) - 1
        return TurntableMotion(self.rings, tuple(standing), angles)

    @property
    def numbers(self) -> int:
        """Number of free numbers, without intrinsics."""
        return sum(POSE + len(ring) - 1 for ring in self.rings)


def turntable_motion(model: SfmModel) -> tuple[SfmModel, TurntableMotion] | None:
    """Return a model in a frame whose z axis is the axis of a turntable, and the motion nearest to its poses.

    The axis is that on which most pairs of photos agree: the motion between two photos of one ring is a turn about it.
    None if fewer than 80 % of the photos are in rings of at least five.
    """
    if len(model.T_cam_world) < LEAST_RING:
        return None
    axis = _axis(model)
    if axis is None:
        return None
    turned = model.transformed(axis)
    centers, names = turned.centers(), list(turned.T_cam_world)
    angles = -np.arctan2(centers[:, 1], centers[:, 0])
    standing = np.array([pose @ about_z(-a) for pose, a in zip(turned.T_cam_world.values(), angles, strict=True)])
    cameras = np.unique([turned.image_camera[name] for name in names], return_inverse=True)[1]
    groups = _groups(standing, float(np.median(np.linalg.norm(centers[:, :2], axis=1))), cameras)
    rings = [group for group in groups if len(group) >= LEAST_RING]
    if sum(map(len, rings)) < _LEAST_IN_RINGS * len(names):
        return None
    rings += [[k] for group in groups if len(group) < LEAST_RING for k in group]
    motion = TurntableMotion(
        tuple(tuple(names[k] for k in ring) for ring in rings),
        tuple(_middle(standing[ring]) for ring in rings),
        {name: float(angle) for name, angle in zip(names, angles, strict=True)},
    )
    return turned, motion


def about_z(angle: float) -> Array:
    """Return the rotation about z by an angle [rad] as a pose, shape (4, 4)."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


def _pose(rotation: Array, center: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return pose


def _axis(model: SfmModel) -> Similarity | None:
    """Return the motion of the world by which the axis of the turns between photos becomes z, through the origin."""
    rotations = np.array([pose[:3, :3].T for pose in model.T_cam_world.values()])
    first, second = np.triu_indices(len(rotations), 1)
    turns = rotations[second] @ np.swapaxes(rotations[first], 1, 2)
    vectors = Rotation.from_matrix(turns).as_rotvec()
    lengths = np.degrees(np.linalg.norm(vectors, axis=1))
    known = (lengths > _TURN_DEG[0]) & (lengths < _TURN_DEG[1])
    if not known.any():
        return None
    first, second, turns = first[known], second[known], turns[known]
    directions = vectors[known] / np.radians(lengths[known])[:, None]
    near = np.cos(np.radians(_AXES_DEG))
    axis = directions[np.argmax((np.abs(directions @ directions.T) > near).sum(1))]
    about = np.abs(directions @ axis) > near
    axis = np.linalg.svd(directions[about])[2][0]
    centers = model.centers()
    shifts = centers[second] - np.einsum("pij,pj->pi", turns, centers[first])
    across = np.linalg.svd(axis[None])[2][1:]
    place = across.T @ _fixed((np.eye(3) - turns[about]) @ across.T, shifts[about])
    rotation = np.array([across[0], np.cross(axis, across[0]), axis])
    return Similarity(1.0, rotation, -rotation @ place)


def _fixed(matrices: Array, shifts: Array) -> Array:
    """Return the x (2,) with the least sum of |A x - b| over matrices (n, 3, 2) and shifts (n, 3)."""
    weight, x = np.ones(len(matrices)), np.zeros(2)
    for _ in range(_REFINED):
        root = np.sqrt(weight)
        x = np.linalg.lstsq((root[:, None, None] * matrices).reshape(-1, 2), (root[:, None] * shifts).ravel())[0]
        away = np.linalg.norm(matrices @ x - shifts, axis=1)
        weight = 1.0 / np.maximum(away, 1e-3 * np.median(away) + np.finfo(float).tiny)
    return np.asarray(x, np.float64)


def _groups(standing: Array, radius: float, cameras: NDArray[np.int64]) -> list[list[int]]:
    """Return the indices of poses (photo, 4, 4) of one camera that are alike, the largest group first."""
    centers = _centers(standing) / radius
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    between = np.einsum("pji,qjk->pqik", standing[:, :3, :3], standing[:, :3, :3])
    cosine = 0.5 * (np.trace(between, axis1=2, axis2=3) - 1.0)
    alike: NDArray[np.bool_] = (apart < _ALIKE) & (cosine > np.cos(_ALIKE)) & (cameras[:, None] == cameras)
    left, groups = np.ones(len(standing), bool), []
    while left.any():
        members = alike & left & left[:, None]
        group = np.flatnonzero(members[members.sum(1).argmax()])
        groups.append([int(k) for k in group])
        left[group] = False
    return groups


def _centers(standing: Array) -> Array:
    """Return the optical centres (photo, 3) of poses (photo, 4, 4)."""
    return -np.einsum("pji,pj->pi", standing[:, :3, :3], standing[:, :3, 3])


def _middle(standing: Array) -> Array:
    """Return the pose in the middle of poses (photo, 4, 4)."""
    centers = _centers(standing)
    return _pose(Rotation.from_matrix(standing[:, :3, :3]).mean().as_matrix(), np.median(centers, axis=0))
