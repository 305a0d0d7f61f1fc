"""Worlds with chains for the tests: pendulums, a pair of fingers, a floating elbow."""

from dataclasses import replace
from typing import Any

import torch
from cgwm.pipeline.physics import Body, State, World
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.kinematic import Drive

from . import worlds
from .worlds import F64, ball_body, batch


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


def drawer(aside_m_s: float) -> tuple[World, State, dict[str, Any]]:
    """Return a drawer on a rail along x that rests on the ground, where it cannot yield, and a finger that pushes it.

    The rail has a dry friction of 2 N and a damping of 8 N s/m; the finger moves at 0.2 m/s, and to the side.
    """
    spheres = ((0.05, 0.0, 0.0, 0.03), (-0.05, 0.0, 0.0, 0.03))
    rail = Joint.of("rail", "slide", "box", "case", axis=(1, 0, 0), damping=8.0, friction=2.0)
    chain = Chain(name="cabinet", root="case", base="fixed", joints=(rail,))
    finger = replace(ball_body(0.01, 0.1), name="finger", motion="driven")
    world = chained(
        chain,
        link("case", 0.0),
        link("box", 1.5, spheres=spheres),
        finger,
        contact=worlds.law(0.3, 0.008, 1.0),
        step_s=0.004,
    )
    state = still(3)
    state.position_m[:, :, 2] = 0.0299
    state.position_m[:, 2, 0] = 0.091
    speed = torch.tensor([[[-0.2, aside_m_s, 0.0]]], dtype=F64)
    place = (state.position_m[:, 2], state.quat_wxyz[:, 2])
    samples = torch.tensor([[0.0, 1.0]], dtype=F64)
    return world, state, {"finger": Drive.from_velocities(samples, *place, speed, 0 * speed)}
