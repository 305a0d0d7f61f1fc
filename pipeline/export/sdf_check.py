"""An SDF document that was written, read again: where its joints put the links at random values."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from ...datasets.exports.sdf import joint_names
from ...datasets.models.model import Model
from ...schemas import ArticulationModel, InputDataError
from .chain_places import Places, Pose, worst_deviation


def sdf_deviation(model: Model, root: ET.Element, seed: int) -> tuple[float, float]:
    """Return how far the joints of a document put links from where they are here, relative to the root.

    Returns:
        The largest distance of the origins of links [mm], and the largest angle between them [deg]; 0 without joints.

    Raises:
        InputDataError: If the document lacks a body.
    """
    found = {one.get("name"): one for one in root.findall("./world/model")}
    wanted = [body.name for body in model.file.bodies if body.motion != "link"]
    lacking = [name for name in [*wanted, *(one.name for one in model.file.articulations)] if name not in found]
    if lacking:
        raise InputDataError(
            f"{model.place}: read again, the SDF has no model '{lacking[0]}'.", todo="report this as a bug."
        )
    return worst_deviation(model, seed, lambda one, wanted: _places(found[one.name], one, wanted))


def _places(document: ET.Element, one: ArticulationModel, wanted: Places) -> dict[str, Pose]:
    """Return the poses of the links of a model relative to its root, at the values of the joints."""
    names = joint_names(one)
    values = {names[joint]: value for joint, value in wanted.joints.items()}
    rest = {str(link.get("name")): _pose(link.findtext("pose")) for link in document.findall("link")}
    poses: dict[str, Pose] = {one.root: (np.zeros(3), np.eye(3))}
    for joint in document.findall("joint"):  # parents stand before their children
        above, below = str(joint.findtext("parent")), str(joint.findtext("child"))
        if above not in rest:
            continue  # the root in the world
        offset = rest[above][1].T @ (rest[below][0] - rest[above][0])
        turn = rest[above][1].T @ rest[below][1]
        moved, turned = _motion(joint, values.get(str(joint.get("name")), 0.0))
        place, axes = poses[above]
        poses[below] = place + axes @ (offset + turn @ moved), axes @ turn @ turned
    return poses


def _motion(joint: ET.Element, value: float) -> Pose:
    """Return the pose of a joint's child, at a value [rad or m], in its frame at 0."""
    axis = np.array([float(word) for word in (joint.findtext("axis/xyz") or "0 0 1").split()])
    if joint.get("type") == "revolute":
        return np.zeros(3), Rotation.from_rotvec(value * axis).as_matrix()
    return (value * axis if joint.get("type") == "prismatic" else np.zeros(3)), np.eye(3)


def _pose(text: str | None) -> Pose:
    values = [float(word) for word in (text or "0 0 0 0 0 0").split()]
    return np.array(values[:3]), Rotation.from_euler("xyz", values[3:]).as_matrix()
