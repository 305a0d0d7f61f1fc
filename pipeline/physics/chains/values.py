"""Values of the parameters of jointed bodies in a world; the parameters themselves: `parameters`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .chain import Chain, Joint

if TYPE_CHECKING:
    from ..body import Body
    from ..world import World

FACTORS = (".mass_factor", ".inertia_factor")
"""Ends of names of parameters that are relative to the model from which a fit started."""


def moving_links(world: World, chain: Chain) -> dict[str, Body]:
    """Return the links that move, by name, in the order of the chain."""
    bodies = {body.name: body for body in world.bodies}
    return {name: bodies[name] for name in chain.links if chain.moves(name)}


def with_chain_values(world: World, column: Mapping[str, Tensor]) -> World:
    """Return the world with the values (B,) of parameters of its jointed bodies, by name.

    A factor of mass is relative to the links that have none: masses are scaled so that their sum stays, unless the
    articulation has a factor of its own, of the masses and inertias of all its moving links.
    """
    if not any("." in name for name in column):
        return world
    for number, chain in enumerate(world.chains):
        joints = tuple(_with_losses(joint, column) for joint in chain.joints)
        chains = list(world.chains)
        chains[number] = replace(chain, joints=joints)
        world = _with_masses(replace(world, chains=tuple(chains)), chain, column)
    return world


def _with_losses(joint: Joint, column: Mapping[str, Tensor]) -> Joint:
    values = {name: column.get(f"{joint.name}.{name}") for name in ("damping", "friction")}
    given = {name: value for name, value in values.items() if value is not None}
    return replace(joint, **given) if given else joint


def _with_masses(world: World, chain: Chain, column: Mapping[str, Tensor]) -> World:
    links = moving_links(world, chain)
    factors = {name: column[f"{name}.mass_factor"] for name in links if f"{name}.mass_factor" in column}
    inertia, every = column.get(f"{chain.name}.inertia_factor"), column.get(f"{chain.name}.mass_factor")
    given = [*factors.values(), *(value for value in (inertia, every) if value is not None)]
    if not given:
        return world
    like = given[0]
    one = torch.ones_like(like)
    raw = {name: factors.get(name, one) * body.mass for name, body in links.items()}
    before = torch.stack([body.mass.expand_as(one) for body in links.values()]).sum(0)
    scale = before / torch.stack(list(raw.values())).sum(0) if factors else one
    scale = scale if every is None else scale * every
    for name, body in links.items():
        mass = raw[name] * scale
        share = mass / body.mass * (one if inertia is None else inertia)
        changes = {"mass": mass, "inertia": body.inertia * share[:, None, None]}
        world = world.with_body(world.body_names.index(name), **changes)
    return world
