"""What data, and throws that could be made, tell of a model's numbers and of rival effects: their information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.tracks import Track
from ..physics.dispatch import rollout as rolled_out
from ..physics.measured import as_measured, true_times
from ..physics.parameters import PRIOR_SCALES
from ..physics.rollout import Rollout
from ..physics.world import State, World
from .candidates import Variant, acts_in, base_parameters
from .cuts import Segment, cut_episodes, whole_episodes
from .phases import is_round
from .prepared import Prepared
from .score import picture
from .segments import Kind, Segments
from .throws import Throw, states_of

Array = NDArray[np.float64]

LEAST_STEP_S = 0.005
"""Throws are simulated with frames no denser than this; the information of denser ones is scaled."""
MOST_CONTACTS = 40
"""Of more contact segments so many, evenly spread, tell what is known already."""


@dataclass(frozen=True)
class Layout:
    """The numbers of the model and of the rivals.

    names (P), the model's first; base: how many those are; prior (P,): information of their priors.
    """

    names: tuple[str, ...]
    base: int
    prior: Array


def layout_of(world: World, variants: Sequence[Variant]) -> Layout:
    """Return the numbers of a world, in flight and in contact, and those of effects beside it."""
    base = {p.name: 1 / p.prior[1] ** 2 for kind in ("flight", "contact") for p in base_parameters(world, kind)}
    own = {
        f"{v.active.effect.name}.{p.name}": 1 / (PRIOR_SCALES * p.scale) ** 2
        for v in variants
        for p in v.active.effect.parameters
    }
    return Layout((*base, *own), len(base), np.array([*base.values(), *own.values()]))


def information_of_data(
    prepared: Prepared, world: World, variants: Sequence[Variant], layout: Layout, discount: float
) -> Array:
    """Return the information (P, P) of the data; it depends on the motion alone, so that states need no fit."""
    found = np.zeros((len(layout.names), len(layout.names)))
    if prepared.flight is not None:
        found += _embedded(prepared.flight, world, variants, layout).sum(0)
    items = prepared.contact_items
    if items:
        places = np.linspace(0, len(items) - 1, min(len(items), MOST_CONTACTS)).round().astype(int)
        some = prepared.segments("contact", world, [items[k] for k in places])
        share = len(items) / len(places) / discount
        found += share * _embedded(some, world, variants, layout).sum(0)
    return found


def throw_states(prepared: Prepared, world: World, throws: Sequence[Throw]) -> State:
    """Return the states (B) in which throws begin: over the middle of where the body was measured."""
    middle = prepared.whole.position_m[prepared.whole.seen > 0].median(0).values
    return states_of(world, world.free[0], throws, middle, prepared.whole.state)


def information_of_throws(
    prepared: Prepared,
    world: World,
    variants: Sequence[Variant],
    layout: Layout,
    throws: Sequence[Throw],
    state: State,
    discount: float,
) -> list[Array | None]:
    """Return the information (P, P) of each throw; None where its simulation diverged.

    Args:
        prepared: The data so far, whose frame rate and noise the throws get.
        world: In which they are simulated.
        variants: The rivals, at neutral.
        layout: The numbers (P).
        throws: The throws (B).
        state: Where they begin (B).
        discount: By what factor contact counts less.
    """
    times, scale = _times(prepared, max(t.duration_s for t in throws))
    with torch.no_grad():
        true = rolled_out(world, state, true_times(world, times.expand(len(throws), -1)))
    measured = as_measured(world, true, times)
    fine = [k for k in range(len(throws)) if bool(torch.isfinite(true.position_m[k]).all())]
    body = world.free[0]
    episodes = [
        (f"{k}", {world.bodies[body].name: _track(measured, k, body, times, throws[k].duration_s, prepared.turned)})
        for k in fine
    ]
    whole = whole_episodes(world, episodes)
    flight, contact, _ = cut_episodes(world, whole, prepared.noise)
    if not prepared.turned and not is_round(world.bodies[body]):
        contact = []
    total = np.zeros((len(fine), len(layout.names), len(layout.names)))
    parts: list[tuple[Kind, list[Segment], float]] = [
        ("flight", flight, scale),
        ("contact", contact, scale / discount),
    ]
    for kind, items, share in parts:
        if items:
            segments = _at_truth(Segments.of(kind, world, whole, items, prepared.noise, prepared.memory), true, fine)
            found = _embedded(segments, world, variants, layout)
            np.add.at(total, np.array([item.episode for item in items]), share * found)
    place = {k: n for n, k in enumerate(fine)}
    return [total[place[k]] if k in place else None for k in range(len(throws))]


def _at_truth(segments: Segments, true: Rollout, rows: Sequence[int]) -> Segments:
    """Return simulated segments with the states that they were simulated with."""
    row = torch.tensor([rows[item.episode] for item in segments.items])
    first = torch.tensor([item.first for item in segments.items])
    state = State(*(getattr(true, key)[row, first] for key in State.__dataclass_fields__))
    return replace(segments, observations=replace(segments.observations, state=state))


def _embedded(segments: Segments, world: World, variants: Sequence[Variant], layout: Layout) -> Array:
    """Return the information (B, P, P) of segments in the layout of all numbers."""
    kind: Kind = segments.kind
    found = np.zeros((len(segments.items), len(layout.names), len(layout.names)))
    if not base_parameters(world, kind) and not any(acts_in(v, kind) for v in variants):
        return found
    groups = [0] * (1 + max(item.episode for item in segments.items))
    seen = picture(segments, world, variants, groups, robust=False)
    place = np.array([layout.names.index(p.name) for p in seen.parameters])
    found[:, place[:, None], place] = np.nan_to_num(seen.information)
    return found


def _times(prepared: Prepared, duration_s: float) -> tuple[Tensor, float]:
    """Return frame times of a throw [s], as dense as the data's, and by what the information is to be multiplied."""
    items: Sequence[Segment] = prepared.contact_items if prepared.flight is None else prepared.flight.items
    times = prepared.whole.times_s
    step = float(torch.cat([times[i.episode, i.first : i.last + 1].diff() for i in items]).median())
    used = max(step, LEAST_STEP_S)
    return used * torch.arange(round(duration_s / used) + 1).to(times), used / step


def _track(measured: Rollout, item: int, body: int, times: Tensor, duration_s: float, turned: bool) -> Track:
    keep = times <= duration_s + 1e-9
    quat = measured.quat_wxyz[item, keep, body].numpy() if turned else None
    return Track(times[keep].numpy(), measured.position_m[item, keep, body].numpy(), quat)
