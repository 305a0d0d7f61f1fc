"""A USD stage that was written, opened again: where its joints put the links, and restitutions of its materials."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ...datasets.exports.usd import prim_name
from ...datasets.models.model import Model
from ...schemas import ContactParameters, InputDataError
from ..physics.contact_law import restitution
from .chain_places import Places, Pose, worst_deviation


def restitutions(model: Model) -> dict[str, float]:
    """Return the restitution of each contact law of a single material, by its name; "" is that of all other pairs."""
    laws = {pair.materials[0]: pair for pair in model.file.pairs if pair.materials[0] == pair.materials[1]}
    assert model.file.contact is not None  # the stage export refuses models without fitted physics
    return {"": _restitution(model.file.contact)} | {name: _restitution(law) for name, law in laws.items()}


def _restitution(law: ContactParameters) -> float:
    return float(restitution(torch.tensor(law.damping_ratio, dtype=torch.float64)))


def usd_deviation(model: Model, text: str, seed: int) -> tuple[float, float]:
    """Return how far the joints of a stage put links from where they are here, relative to the root.

    Returns:
        The largest distance of the origins of links [mm], and the largest angle between them [deg]; 0 without joints.

    Raises:
        InputDataError: If the stage cannot be opened, or lacks a body.
    """
    stage = opened(text)
    lacking = [body.name for body in model.file.bodies if not stage.GetPrimAtPath(f"/World/{prim_name(body.name)}")]
    if lacking:
        raise InputDataError(
            f"{model.place}: opened again, the stage has no body '{lacking[0]}'.", todo="report this as a bug."
        )
    return worst_deviation(model, seed, lambda _, wanted: _places(stage, wanted))


def opened(text: str) -> Any:
    """Return the stage of a text (.usda)."""
    layer = importlib.import_module("pxr.Sdf").Layer.CreateAnonymous(".usda")
    layer.ImportFromString(text)
    return importlib.import_module("pxr.Usd").Stage.Open(layer)


def _places(stage: Any, wanted: Places) -> dict[str, Pose]:
    """Return the poses of the links relative to the root, by the joints of the stage alone."""
    names = {f"/World/{prim_name(name)}": name for name in wanted.places}
    values = {prim_name(f"{name}_joint"): value for name, value in wanted.joints.items()}
    joints = [prim for prim in stage.Traverse() if prim.GetTypeName().endswith("Joint")]
    poses: dict[str, Pose] = {wanted.root: (np.zeros(3), np.eye(3))}
    for _ in names:  # parents may stand behind their children
        for prim in joints:
            ends = [prim.GetRelationship(f"physics:body{k}").GetTargets() for k in (0, 1)]
            above, below = (names.get(str(targets[0])) if targets else None for targets in ends)
            if above in poses and below is not None:
                poses[below] = _carried(prim, poses[above], values.get(prim.GetName(), 0.0))
    return poses


def _carried(prim: Any, above: Pose, value: float) -> Pose:
    """Return the pose of the second body of a joint, given that of the first and the value [rad or m]."""
    (place0, turn0), (place1, turn1) = (_local(prim, k) for k in (0, 1))
    axis = np.eye(3)["XYZ".index(prim.GetAttribute("physics:axis").Get() or "X")]
    hinge = prim.GetTypeName() == "PhysicsRevoluteJoint"
    moved = Rotation.from_rotvec(axis * value).as_matrix() if hinge else np.eye(3)
    offset = np.zeros(3) if hinge else axis * value
    turn = above[1] @ turn0 @ moved @ turn1.T
    return above[0] + above[1] @ (place0 + turn0 @ offset) - turn @ place1, turn


def _local(prim: Any, number: int) -> Pose:
    place = np.array(prim.GetAttribute(f"physics:localPos{number}").Get(), float)
    quat = prim.GetAttribute(f"physics:localRot{number}").Get()
    return place, Rotation.from_quat([quat.GetReal(), *quat.GetImaginary()], scalar_first=True).as_matrix()
