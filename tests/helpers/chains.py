"""Worlds with chains for the tests: pendulums, a pair of fingers, a floating elbow."""

from dataclasses import replace
from typing import Any

import torch
from cgwm.pipeline.physics import Body, World
from cgwm.pipeline.physics.chain import Chain, Joint

from . import worlds
from .worlds import F64, batch


def link(
    name: str,
    mass: float = 0.3,
    half: tuple[float, float, float] = (0.05, 0.02, 0.01),
    com: tuple[float, float, float] = (0.05, 0.0, 0.0),
    spheres: tuple[tuple[float, float, float, float], ...] = (),
) -> Body:
    """Return a link: a box about its centre of mass, spheres (x, y, z, radius) where they are given."""
    squares = torch.tensor(half, dtype=F64).square()
    rows = torch.tensor(spheres, dtype=F64).reshape(-1, 4)
    return Body(
        name=name,
        motion="link",
        mass=batch(mass),
        inertia=batch(torch.diag(mass / 3 * (squares.sum() - squares))),
        com=batch(list(com)),
        centers=rows[None, :, :3],
        radii=rows[None, :, 3],
    )


def chained(chain: Chain | tuple[Chain, ...], *bodies: Body, **more: Any) -> World:
    """Return a world with chains; see `worlds.world_of`."""
    chains = chain if isinstance(chain, tuple) else (chain,)
    return replace(worlds.world_of(*bodies, **more), chains=chains)


def double_pendulum(base: str = "fixed", **joint: float) -> tuple[Chain, list[Body]]:
    """Return two links that swing about y below a root without mass, or behind one with mass (base "free")."""
    bodies = [link("base", 0.3 if base == "free" else 0.0), link("upper"), link("lower", 0.2)]
    joints = (
        Joint.of("first", "hinge", "upper", "base", axis=(0, 1, 0), **joint),
        Joint.of("second", "hinge", "lower", "upper", position_m=(0.1, 0, 0), axis=(0, 1, 0), **joint),
    )
    return Chain(name="arm", root="base", base=base, joints=joints), bodies


def still(count: int, size: int = 1) -> "worlds.State":
    """Return a state with all bodies at the origin, at rest."""
    row = ((0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))
    return worlds.state_of(*[row] * count, count=size)
