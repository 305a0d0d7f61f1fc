"""Parameters of jointed bodies that a fit may change: joints' damping and dry friction, shares of mass, inertia.

Motion tells ratios of masses alone: the contact law is one of times, so that all masses together change nothing.
"""

from __future__ import annotations

import math

from torch import Tensor

from ..body import Body
from ..parameters import Parameter
from ..world import World
from .chain import Chain, Joint
from .values import moving_links

LOSS_SHARE = 0.01
"""Median of the prior of dry friction, as a share of the weight's torque about the joint where the file gives none; of
damping, as a share of that torque at the speed of a swing."""
LOSS_STD, MASS_STD, INERTIA_STD = 1.5, 0.3, 0.4
"""Standard deviations of the priors' logarithms: of losses in joints, shares of mass, and inertia."""
GRAVITY_M_S2 = 9.81
LOSSES = (".damping", ".friction")
"""Ends of the names of losses in joints."""


def chain_parameters(world: World) -> list[Parameter]:
    """Return the parameters of all jointed bodies of a world, named by joint, link and articulation."""
    return [parameter for chain in world.chains for parameter in _of_chain(world, chain)]


def _of_chain(world: World, chain: Chain) -> list[Parameter]:
    found = [p for joint in chain.moving for p in _losses(world, chain, joint)]
    bodies = moving_links(world, chain)
    if chain.base == "free":
        found += [_mass_share(name) for name in list(bodies)[1:]]
    if chain.base == "free" or any(joint.kind == "hinge" for joint in chain.moving):  # slides alone turn nothing
        reveals = "impacts that change the spins of links"
        found.append(_positive(f"{chain.name}.inertia_factor", "1", 1.0, INERTIA_STD, (0.1, 10.0), reveals))
    return found


def _losses(world: World, chain: Chain, joint: Joint) -> list[Parameter]:
    hinge = joint.kind == "hinge"
    column = chain.joint_names.index(joint.name)
    below = [body for name, body in moving_links(world, chain).items() if chain.above[chain.links.index(name)][column]]
    mass = sum(float(body.mass[0]) for body in below)
    arm = math.sqrt(
        sum(float(body.mass[0]) * float(body.com[0].square().sum()) + float(_trace(body)) / 2 for body in below) / mass
    )
    weight = mass * GRAVITY_M_S2 * (arm if hinge else 1.0)
    swing = math.sqrt(GRAVITY_M_S2 / arm) if hinge else math.sqrt(GRAVITY_M_S2 * arm)
    units = ("N m s/rad", "N m") if hinge else ("N s/m", "N")
    rows = (("damping", units[0], weight / swing, joint.damping), ("friction", units[1], weight, joint.friction))
    return [
        _positive(
            f"{joint.name}.{name}",
            unit,
            float(given[0]) if float(given[0]) > 0 else LOSS_SHARE * scale,
            LOSS_STD,
            (1e-5 * scale, 10 * scale),
            f"motion of the joint '{joint.name}' between contacts, as after a shove, or measured forces that push it",
        )
        for name, unit, scale, given in rows
    ]


def mass_factor(chain: Chain) -> Parameter:
    """Return the factor of the masses and inertias of all moving links, which forces tell and motion alone does not."""
    return _positive(f"{chain.name}.mass_factor", "1", 1.0, MASS_STD, (0.2, 5.0), "measured forces that accelerate it")


def _trace(body: Body) -> Tensor:
    return body.inertia[0].diagonal().sum()


def _mass_share(link: str) -> Parameter:
    return _positive(
        f"{link}.mass_factor",
        "1",
        1.0,
        MASS_STD,
        (0.2, 5.0),
        "flight in which links turn against each other, and impacts",
    )


def _positive(name: str, unit: str, median: float, std: float, bounds: tuple[float, float], reveals: str) -> Parameter:
    low, high = bounds
    return Parameter(
        name=name, unit=unit, bounds=bounds, logarithmic=True, reveals=reveals,
        prior=(min(max(median, low), high), std),
    )  # fmt: skip
