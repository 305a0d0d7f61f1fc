"""Fisher information of data and of simulated experiments on the parameters of a model and of rival effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.tracks import Episode, Track
from ...physics.engine import rollout as rolled_out
from ...physics.observation_model import as_measured, true_times
from ...physics.parameters import PRIOR_SCALES
from ...physics.rollout import Rollout
from ...physics.state import State
from ...physics.world import World
from ...segments.candidates import Variant, acts_in, base_parameters
from ...segments.contact_phases import is_round
from ...segments.linearization import linearize
from ...segments.prepare import Prepared
from ...segments.segments import Kind, Segments
from ...trajectories.segmentation import Segment, cut_episodes, whole_episodes
from .experiments import Experiment, states_of

Array = NDArray[np.float64]

LEAST_STEP_S = 0.005
"""Minimum frame interval of simulated experiments [s]; the information of denser frames is obtained by scaling."""
MOST_CONTACTS = 40
"""Maximum number of contact segments whose information is computed; of more, an evenly spread subset is scaled up."""


@dataclass(frozen=True)
class Layout:
    """Order of the parameters of the model and of the rivals."""

    names: tuple[str, ...]
    """Names of the parameters (P), the model's first."""
    base: int
    """Number of the model's parameters."""
    prior: Array
    """Prior information of each parameter, shape (P,)."""


def layout_of(world: World, variants: Sequence[Variant]) -> Layout:
    """Return the order of a world's parameters, in flight and in contact, followed by those of the variants."""
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
    """Return the information (P, P) of the data.

    It depends on the motion alone, so the states need no fit.

    Args:
        prepared: The episodes.
        world: The world without the rivals.
        variants: The rivals, at neutral.
        layout: Order of the parameters (P).
        discount: Factor by which the information of contact is reduced.
    """
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


def experiment_states(prepared: Prepared, world: World, throws: Sequence[Experiment]) -> State:
    """Return the start states (B) of experiments, above the median of the measured positions."""
    middle = prepared.observations.position_m[prepared.observations.seen > 0].median(0).values
    return states_of(world, world.free[0], throws, middle, prepared.observations.state)


def information_of_experiments(
    prepared: Prepared,
    world: World,
    variants: Sequence[Variant],
    layout: Layout,
    throws: Sequence[Experiment],
    state: State,
    discount: float,
) -> list[Array | None]:
    """Simulate experiments and return the information (P, P) of each; None where the simulation diverged.

    Args:
        prepared: The data so far; the experiments get their frame rate and noise.
        world: World of the simulation.
        variants: The rivals, at neutral.
        layout: Order of the parameters (P).
        throws: The experiments (B).
        state: Their start states (B).
        discount: Factor by which the information of contact is reduced.
    """
    times, scale = _times(prepared, max(t.duration_s for t in throws))
    with torch.no_grad():
        true = rolled_out(world, state, true_times(world, times.expand(len(throws), -1)))
    measured = as_measured(world, true, times)
    fine = [k for k in range(len(throws)) if bool(torch.isfinite(true.position_m[k]).all())]
    body = world.free[0]
    episodes = [
        Episode(
            f"{k}",
            {world.bodies[body].name: _track(measured, k, body, times, throws[k].duration_s, prepared.has_orientation)},
        )
        for k in fine
    ]
    whole = whole_episodes(world, episodes)
    flight, contact, _ = cut_episodes(world, whole, prepared.noise)
    if not prepared.has_orientation and not is_round(world.bodies[body]):
        contact = []
    total = np.zeros((len(fine), len(layout.names), len(layout.names)))
    parts: list[tuple[Kind, list[Segment], float]] = [
        ("flight", flight, scale),
        ("contact", contact, scale / discount),
    ]
    for kind, items, share in parts:
        if items:
            segments = _at_truth(
                Segments.of(kind, world, whole, items, prepared.noise, prepared.noise_model), true, fine
            )
            found = _embedded(segments, world, variants, layout)
            np.add.at(total, np.array([item.episode for item in items]), share * found)
    place = {k: n for n, k in enumerate(fine)}
    return [total[place[k]] if k in place else None for k in range(len(throws))]


def _at_truth(segments: Segments, true: Rollout, rows: Sequence[int]) -> Segments:
    """Return simulated segments with their true states."""
    row = torch.tensor([rows[item.episode] for item in segments.items])
    first = torch.tensor([item.first for item in segments.items])
    state = State(*(getattr(true, key)[row, first] for key in State.__dataclass_fields__))
    return replace(segments, observations=replace(segments.observations, state=state))


def _embedded(segments: Segments, world: World, variants: Sequence[Variant], layout: Layout) -> Array:
    """Return the information (B, P, P) of segments in the order of all parameters."""
    kind: Kind = segments.kind
    found = np.zeros((len(segments.items), len(layout.names), len(layout.names)))
    if not base_parameters(world, kind) and not any(acts_in(v, kind) for v in variants):
        return found
    groups = [0] * (1 + max(item.episode for item in segments.items))
    linear = linearize(segments, world, variants, groups, robust=False)
    place = np.array([layout.names.index(p.name) for p in linear.parameters])
    found[:, place[:, None], place] = np.nan_to_num(linear.information)
    return found


def _times(prepared: Prepared, duration_s: float) -> tuple[Tensor, float]:
    """Return the frame times [s] of an experiment and the factor that scales its information to the data."""
    items: Sequence[Segment] = prepared.contact_items if prepared.flight is None else prepared.flight.items
    times = prepared.observations.times_s
    step = float(torch.cat([times[i.episode, i.first : i.last + 1].diff() for i in items]).median())
    used = max(step, LEAST_STEP_S)
    return used * torch.arange(round(duration_s / used) + 1).to(times), used / step


def _track(measured: Rollout, item: int, body: int, times: Tensor, duration_s: float, turned: bool) -> Track:
    """Return the track of a body in one simulated experiment."""
    keep = times <= duration_s + 1e-9
    quat = measured.quat_wxyz[item, keep, body].numpy() if turned else None
    return Track(times[keep].numpy(), measured.position_m[item, keep, body].numpy(), quat)
