"""Chains and links of the engine from an articulated body of a URDF or MJCF file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.robots import Articulation, JointOfRobot, LinkOfRobot
from ....schemas import UsageError
from ..body import Body
from ..smooth_distance import plane_contacts
from .chain import Chain, Joint

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Servo:
    """Numbers of the servos of a chain, which replace those of the file; None keeps the file's."""

    stiffness: float | None = None
    """Gain k [N m/rad]."""
    damping: float | None = None
    """Damping d [N m s/rad]."""
    armature: float | None = None
    """Reflected inertia I [kg m2]."""
    torque_limit: float | None = None
    """Largest torque [N m]."""


def chain_of(
    articulation: Articulation,
    spheres: Mapping[str, tuple[Array, Array]],
    base: str,
    servo: Servo | Mapping[str, Servo] | None = None,
    *,
    massless: bool = False,
    like: Tensor | None = None,
) -> tuple[Chain, list[Body]]:
    """Return the chain of an articulated body, and its links as bodies, the root first.

    Args:
        articulation: The articulated body.
        spheres: Centres (n, 3) and radii (n,) [m] of the spheres of each link, in its frame.
        base: How the root moves: "free", "driven" or "fixed".
        servo: Numbers of all servos, or by joint name.
        massless: Whether the links have no mass beside the reflected inertia of geared servos.
        like: Tensor with the type and device of the result; None for float64 on the CPU.

    Raises:
        UsageError: If a servo is given for a joint that does not exist.
        InputDataError: If a joint has a servo and no limits.
    """
    like = torch.zeros((), dtype=torch.float64) if like is None else like
    joints = _served(articulation, servo)
    served = replace(articulation, joints=tuple(joint for joint in joints if joint.stiffness > 0))
    served.require_limits()
    made = [
        Joint.of(
            joint.name, joint.kind, joint.link, joint.parent,
            position_m=joint.position_m.tolist(), quat_wxyz=joint.quat_wxyz.tolist(), axis=joint.axis.tolist(),
            lower=joint.lower, upper=joint.upper, stiffness=joint.stiffness, damping=joint.damping,
            armature=joint.armature, friction=joint.friction, torque_limit=joint.torque_limit, like=like,
        )
        for joint in joints
    ]  # fmt: skip
    chain = Chain(name=articulation.name, root=articulation.links[0].name, base=base, joints=tuple(made))
    return chain, [_body(link, *spheres[link.name], massless, like) for link in articulation.links]


def _served(articulation: Articulation, servo: Servo | Mapping[str, Servo] | None) -> list[JointOfRobot]:
    """Return the joints of an articulated body with the numbers of their servos; arguments as in `chain_of`."""
    names = [joint.name for joint in articulation.joints if joint.kind != "fixed"]
    servos = servo if isinstance(servo, Mapping) else {name: servo for name in names if servo is not None}
    unknown = [name for name in servos if name not in names]
    if unknown:
        raise UsageError(
            f"{articulation.path}: there is no moving joint '{unknown[0]}'.",
            ", ".join(names) + ".",
            "name one of these joints.",
        )
    joints = []
    for joint in articulation.joints:
        given = servos.get(joint.name)
        changed = {} if given is None else {key: value for key, value in vars(given).items() if value is not None}
        joints.append(replace(joint, **changed))
    return joints


def _body(link: LinkOfRobot, centers: Array, radii: Array, massless: bool, like: Tensor) -> Body:
    def tensor(value: object) -> Tensor:
        return torch.as_tensor(np.asarray(value), dtype=like.dtype, device=like.device)[None]

    places, sizes = tensor(centers), tensor(radii)
    keep = 0.0 if massless else 1.0
    return Body(
        name=link.name,
        motion="link",
        mass=tensor(keep * link.mass_kg),
        inertia=tensor(keep * link.inertia_kg_m2),
        com=tensor(link.com_m),
        centers=places,
        radii=sizes,
        on_plane=plane_contacts(places[0], sizes[0]) if len(radii) else None,
    )
