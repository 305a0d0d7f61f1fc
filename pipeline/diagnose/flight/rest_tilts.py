"""Tilt of a tracking frame as bodies at rest show it: a face that lies on the ground is level, whatever is measured.

A frame turned by R against gravity and ground measures the face's normal as R e_z and gravity as -g R e_z, so that the
acceleration of its flights is -g times the level part of that normal. Where the ground itself is not level, and each
episode was turned about the vertical, both are turned and scaled alike in all episodes. No force in flight does this.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.hull_faces import hull_faces
from ...geometry.rotation import quat_to_matrix
from ...physics.body import Body
from ...segments.prepare import Prepared
from ..thresholds import THRESHOLDS
from .own_accelerations import OwnAccelerations, follows

LIMITS = THRESHOLDS.verdict

Array = NDArray[np.float64]


def rests_confirm(prepared: Prepared, body: Body, gravity_m_s2: float, found: OwnAccelerations) -> bool:
    """Return whether bodies at rest are tilted as accelerations of the episodes' flights are, if these are tilts.

    Args:
        prepared: The episodes.
        body: The free body.
        gravity_m_s2: Gravity, along the third axis.
        found: Accelerations of the flights.
    """
    tilts = rest_tilts(prepared, body)
    episodes, values = np.unique(found.episode), found.by_episode()
    known = np.array([int(episode) in tilts for episode in episodes])
    if known.sum() < LIMITS.own_episodes:
        return False
    level = np.array([tilts[int(episode)] for episode in episodes[known]])
    p_value, slope, across = follows(values[known], level)
    size = np.hypot(slope, across) / gravity_m_s2
    return p_value < LIMITS.repeated_p and slope < 0 and LIMITS.rest_times[0] < size < LIMITS.rest_times[1]


def rest_tilts(prepared: Prepared, body: Body) -> dict[int, Array]:
    """Return the level part (2,) of the upward normal of the face that a body lies on, by episode that ends at rest."""
    normals = _face_normals(body)
    if not prepared.has_orientation or not len(normals):
        return {}
    seen, found = prepared.observations, {}
    still = LIMITS.still_rad + 4 * prepared.noise.rotation_rad
    for episode in range(len(prepared.names)):
        frames = torch.nonzero((seen.has_orientation[episode, :, 0] > 0) & ~prepared.airborne[episode])[:, 0]
        if len(frames) < LIMITS.rest_frames:
            continue
        turns = quat_to_matrix(seen.quat_wxyz[episode, frames, 0]).double().numpy()
        same = np.array([np.arccos(np.clip((np.trace(turns[-1].T @ one) - 1) / 2, -1, 1)) < still for one in turns])
        count = len(same) if same.all() else int(np.argmin(same[::-1]))
        if count < LIMITS.rest_frames:
            continue
        up = -(turns[-count:] @ normals.T)  # (n, 3, faces)
        face = int(up[:, 2].mean(0).argmax())
        mean = up[:, :, face].mean(0)
        if np.hypot(*mean[:2]) < LIMITS.face_rad:
            found[episode] = mean[:2]
    return found


def _face_normals(body: Body) -> Array:
    """Return the outward normals (F, 3) of the faces of a body's colliding spheres; none for a round one."""
    chosen = slice(None) if body.on_plane is None else body.on_plane
    points = body.centers[0].double()[chosen].numpy()
    radii = body.radii[0].double()[chosen].numpy()
    # a face of spheres of several sizes is not that of their centres
    flat = [face.normal for face in hull_faces(points) if np.ptp(radii[face.corners]) < 1e-3 * radii.max()]
    return np.unique(np.array(flat).reshape(-1, 3).round(6), axis=0)
