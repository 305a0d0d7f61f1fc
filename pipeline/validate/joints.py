"""Checks of jointed bodies in rollouts: names of the joints, links on their joints, rates, and limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ...schemas import ArticulationModel
from ..geometry.rotation import quat_rotate
from ..physics.chains.chain import chain_of_model, link_velocities
from .faults import Fault
from .rollout import Rollout, shown

OFF_JOINT_M, OFF_JOINT_RAD = 1e-6, 1e-6
"""Largest distance [m] and angle [rad] of a link from where its joint puts it; rounding of float64 is far below."""
OFF_RATE = 1e-6
"""Largest difference of a link's velocities from those that root and joints give, in units of the largest velocity of
the rollout, or of 1 where that is less."""


def check_joints(rollout: Rollout) -> Iterator[Fault]:
    """Compare the poses and velocities of links with the joints, by the kinematics of the dataset's model."""
    model = rollout.dataset.model
    if "joints/names" not in rollout.values or model is None or not model.file.articulations:
        return
    values = rollout.values
    names = [name.decode("utf-8", "replace") for name in values["joints/names"].tolist()]
    moving = [joint for one in model.file.articulations for joint in one.joints if joint.kind != "fixed"]
    wanted = [joint.name for joint in moving]
    if names != wanted:
        found = ", ".join(map(shown, names))
        yield Fault(check="joints", text=f"joints/names: {found}; the dataset's model has {', '.join(wanted)}.")
        return
    for key, texts in (("links", [j.link for j in moving]), ("kinds", [j.kind for j in moving])):
        if values[f"joints/{key}"].tolist() != [text.encode() for text in texts]:
            yield Fault(check="joints", text=f"joints/{key}: the dataset's model has {', '.join(texts)}.")
            return
    first = 0
    for one in model.file.articulations:
        count = sum(joint.kind != "fixed" for joint in one.joints)
        if set(one.links) <= set(rollout.bodies):
            yield from _check_links(rollout, one, slice(first, first + count))
        first += count


def _check_links(rollout: Rollout, one: ArticulationModel, columns: slice) -> Iterator[Fault]:
    rows = [rollout.bodies.index(link) for link in one.links]
    pose, quats, velocity, omega = (
        torch.as_tensor(rollout.values[f"bodies/{key}"][:, rows]) for key in ("pos", "quat_wxyz", "vel", "omega_body")
    )
    angles, rates = (torch.as_tensor(rollout.values[f"joints/{key}"][:, columns]) for key in ("pos", "vel"))
    chain = chain_of_model(one, pose)
    place, turn = chain.poses(pose[:, 0], quats[:, 0], angles)
    spin = quat_rotate(quats, omega)
    linear, turning = link_velocities(chain, pose, quats, (velocity[:, 0], spin[:, 0]), rates)
    away = (place - pose).norm(dim=-1).numpy()
    angle = 2 * np.arccos(np.clip(np.abs((turn * quats).sum(-1).numpy()), 0, 1))
    # near 1 the cosine is too coarse: the difference of the quaternions, of either sign, is twice the sine of a quarter
    chord = torch.minimum((turn - quats).norm(dim=-1), (turn + quats).norm(dim=-1)).numpy()
    angle = np.where(chord < 1e-3, 2 * chord, angle)
    fast = max(1.0, float(velocity.abs().max()), float(omega.abs().max()))
    slip = torch.maximum((linear - velocity).norm(dim=-1), (turning - spin).norm(dim=-1)).numpy() / fast
    for what, off, limit, unit in (
        ("m from where its joint puts it", away, OFF_JOINT_M, "bodies/pos"),
        ("rad from where its joint puts it", angle, OFF_JOINT_RAD, "bodies/quat_wxyz"),
        ("of its speed from that of root and joints", slip, OFF_RATE, "bodies/vel"),
    ):
        if not off.max(initial=0.0) <= limit:
            frame, link = (int(k) for k in np.unravel_index(np.argmax(off), off.shape))
            text = f"{unit}: frame {frame}: link '{one.links[link]}' is {off[frame, link]:.3g} {what}."
            yield Fault(
                check="joints",
                text=text,
                frame=frame,
                body=one.links[link],
                value=float(off[frame, link]),
                limit=limit,
            )
            return
