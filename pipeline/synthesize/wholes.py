"""Jointed bodies as wholes: one rigid body that stands for all links of each, and the links put back on their joints.

A start is drawn for the whole of a jointed body at its drawn joint values, as for a rigid body with the spheres of all
links; then the links are put on their joints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...datasets.models.model import Model
from ...datasets.shapes.ply import Splats
from ...schemas import ArticulationModel, InputDataError
from ...schemas.articulations import JointModel
from ..geometry.rotation import quat_conjugate, quat_rotate
from ..geometry.viewpoint import rotation_matrix
from ..physics.chains.chain import Chain, chain_of_model, link_velocities

StartArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Position, quaternion, velocity and omega_body of all bodies."""
_LIKE = torch.zeros(1, dtype=torch.float64)


@dataclass(frozen=True)
class JointedStart:
    """A jointed body with drawn joints."""

    entry: ArticulationModel
    """The jointed body."""
    chain: Chain
    """Its kinematics."""
    values: np.ndarray
    """Values of the joints that move [rad or m], shape (J,)."""
    speeds: np.ndarray
    """Their rates [rad/s or m/s], shape (J,)."""

    @staticmethod
    def of(entry: ArticulationModel, value: Callable[[JointModel], float]) -> JointedStart:
        """Return a jointed body whose joints have the values of a function, and do not move."""
        moving = [joint for joint in entry.joints if joint.kind != "fixed"]
        values = np.array([value(joint) for joint in moving])
        return JointedStart(entry, chain_of_model(entry, _LIKE), values, np.zeros(len(moving)))

    def poses(self, position: Tensor, quat: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses (1, L, 3) [m] and (1, L, 4) of the links, given those of the root (1, 3) and (1, 4)."""
        return self.chain.poses(position, quat, torch.as_tensor(self.values)[None])


def require_startable(model: Model) -> None:
    """Refuse jointed bodies whose start cannot be drawn.

    Raises:
        InputDataError: If the root of one is driven, or a slide has no limits.
    """
    for one in model.file.articulations:
        if one.base == "driven":
            raise InputDataError(
                f"{model.place}: the root '{one.root}' of the jointed body '{one.name}' is driven, and sampling plans "
                "have paths of single bodies alone.",
                'jointed bodies with base = "free" or "fixed".',
                "simulate it with the Python API (docs/python-api.md).",
            )
        endless = next((j.name for j in one.joints if j.kind == "slide" and (j.lower is None or j.upper is None)), None)
        if endless is not None:
            raise InputDataError(
                f"{model.place}: the slide '{endless}' has no limits, so its start cannot be drawn.",
                "slides with lower and upper.",
                "give it limits in the URDF or MJCF file of the capture, and fit again.",
            )


def at_middle(model: Model) -> Model:
    """Return the model with each jointed body as one rigid body, its joints in the middle of their limits, or at 0."""
    if not model.file.articulations:
        return model
    return with_wholes(model, [JointedStart.of(one, middle) for one in model.file.articulations])


def middle(joint: JointModel) -> float:
    """Return the value in the middle of a joint's limits; 0 where it lacks one."""
    return 0.0 if joint.lower is None or joint.upper is None else 0.5 * (joint.lower + joint.upper)


def with_wholes(model: Model, joints: list[JointedStart]) -> Model:
    """Return the model with each jointed body as one rigid body, under the name of its root."""
    roots = {one.entry.root: one for one in joints}
    bodies = tuple(
        body.model_copy(update={"motion": "free" if roots[body.name].entry.base == "free" else "fixed"})
        if body.name in roots
        else body
        for body in model.file.bodies
    )
    collision = dict(model.collision)
    for name, one in roots.items():
        collision[name] = _whole(model, one)
    file = model.file.model_copy(update={"bodies": bodies, "articulations": ()})
    return replace(model, file=file, collision=collision)


def _whole(model: Model, one: JointedStart) -> Splats:
    """Return the spheres of all links in the frame of the root."""
    origin = torch.zeros(1, 3, dtype=torch.float64)
    position, quat = one.poses(origin, torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    factor = model.body(one.entry.root).radius_factor
    parts = []
    for k, link in enumerate(one.entry.links):
        spheres = model.collision[link]
        means = np.asarray(spheres.means, float) @ rotation_matrix(quat[0, k].numpy()).T + position[0, k].numpy()
        scales = np.asarray(spheres.scales, float) * model.body(link).radius_factor / factor
        parts.append((means, scales, spheres.opacities, spheres.colors))
    means, scales, opacities, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Splats(means, scales, opacities, colors)


def put_links(start: StartArrays, names: list[str], joints: list[JointedStart]) -> None:
    """Put the links where the root and the joints say, in place.

    Args:
        start: Position, quaternion, velocity and omega_body of all bodies, shapes (nb, 3) or (nb, 4).
        names: Names of the bodies.
        joints: The jointed bodies.
    """
    places, quats, velocities, omegas = start
    for one in joints:
        rows = [names.index(link) for link in one.entry.links]
        root = [torch.as_tensor(array[rows[0]])[None] for array in start]
        position, quat = one.poses(root[0], root[1])
        base = (root[2], quat_rotate(root[1], root[3]))
        linear, omega = link_velocities(one.chain, position, quat, base, torch.as_tensor(one.speeds)[None])
        places[rows], quats[rows] = position[0].numpy(), quat[0].numpy()
        velocities[rows], omegas[rows] = linear[0].numpy(), quat_rotate(quat_conjugate(quat), omega)[0].numpy()
