"""A tilt of each episode's own: the frame, or gravity in it, is level in another way in every episode.

Its evidence is that of the variance component of `slow_errors`: accelerations across gravity that are constant
in a flight and differ from flight to flight. In flight a tilt of the frame and one of gravity are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...optimization.tails import chi2_tail
from ...physics.effects.effect import ActiveEffect
from ...physics.effects.registry import load_effect
from ...physics.world import World
from ...segments.candidates import Candidate, base_parameters, variants_of, with_added, without_effects
from ...segments.flights.residual_wrench import residual_wrenches
from ...segments.flights.slow_errors import SlowErrors
from ...segments.linearization import linearize
from ...segments.prepare import Prepared
from ...segments.segment_fit import Refit, refit
from ...segments.segment_states import fit_states
from ...segments.segments import Segments
from ..evidence.effect_selection import SelectionStep
from ..evidence.evidence import Evidence, prior_odds
from ..evidence.score_test import ScoreTest, solved
from ..thresholds import THRESHOLDS
from .coupled_effects import DRAGS
from .form_families import OWN_TILTS
from .other_forms import own_form
from .own_accelerations import OwnAccelerations
from .rest_tilts import rests_confirm
from .specific_values import specific_evidence, values_of_each, with_specific

LIMITS = THRESHOLDS.verdict

TILTS = ("gravity_tilt", "frame_tilt", "constant_force", "wind")
"""Effects that push across gravity, the same in all episodes: a tilt of each episode's own contains their mean."""
PIECE_S, LONGEST_S = 0.15, 60.0
"""Length [s] of the pieces of flight between which a tilt of an episode's own may not change, half a flight where that
is less; and one above that of any flight."""


@dataclass(frozen=True)
class OwnTilts:
    """What accelerations across gravity are that differ from episode to episode."""

    kind: Literal["tilts", "levelling", "force", "none"]
    """Tilts of each episode's own; such that few episodes do not prove, as small as errors of levelling; a force, or
    what may be one; or nothing that lasts for an episode."""
    law: str | None = None
    """What a force follows; "episode" where there are too few episodes to tell."""


def own_tilts(prepared: Prepared, world: World, candidates: Sequence[Candidate], slow: SlowErrors) -> OwnTilts:
    """Return what the accelerations of the flights' own are that slow errors have.

    A tilt has to be the same in all pieces of an episode's flights (a gust pushes in some of them), to predict each
    piece from the others, to be likelier than other forms of a force (`other_forms`), and to follow nothing in the
    motion; or the bodies have to lie on the ground as tilted.

    Args:
        prepared: The episodes, without slow errors as part of their noise.
        world: The world with the effects selected in flight.
        candidates: All candidates.
        slow: The slow errors.
    """
    if not slow.sway_evidence or float(world.gravity[0].norm()) == 0 or not (names := _missing(world, candidates)):
        return OwnTilts("none")
    if any(active.effect.name == "wind" for active in world.effects):
        return OwnTilts("none")  # a drag in wind pushes a box that turns as if each flight were tilted
    # the noise has the slow process, but no acceleration of a flight's own
    position = slow.noise_model.position._replace(sway=0.0)
    swayless = replace(prepared, noise_model=slow.noise_model._replace(position=position))
    whole = swayless.pieces(world, LONGEST_S)
    return OwnTilts("none") if whole is None else _told(swayless, world, names[0], whole, slow)


def _told(prepared: Prepared, world: World, name: str, whole: Segments, slow: SlowErrors) -> OwnTilts:
    """Return what the accelerations of whole flights are, by bodies at rest, by pieces of flight, and by the motion."""
    level, gravity = prepared.noise_model.position.level, float(world.gravity[0].norm())
    accelerations = OwnAccelerations.of(residual_wrenches(whole.in_world(_bare(world))), level)
    if rests_confirm(prepared, world.bodies[world.free[0]], gravity, accelerations):
        return OwnTilts("tilts")
    std_m_s2 = slow.sway_m_s2(prepared.noise.position_m)
    pieces = prepared.pieces(world, min(PIECE_S, 0.5 * _median_length_s(whole)))
    lasting = pieces is not None and _lasting_share(pieces, world, name, prepared.groups) > LIMITS.lasting_share
    if pieces is None or not lasting:
        return OwnTilts("none")
    by_piece = OwnAccelerations.of(residual_wrenches(pieces.in_world(_bare(world))), level)
    if float(by_piece.held_out_gains(std_m_s2).sum()) <= 0:
        return OwnTilts("none")
    form = own_form(whole, _bare(world), std_m_s2)
    if form.odds > -LIMITS.form_odds:
        return OwnTilts("force", form.coordinate)
    return _kind(accelerations, std_m_s2 / gravity, form.odds < LIMITS.form_odds)


def _median_length_s(whole: Segments) -> float:
    """Return the median length of flights [s]."""
    times = whole.observations.times_s
    return float(np.median([float(times[k, n - 1] - times[k, 0]) for k, n in enumerate(whole.lengths)]))


def _kind(accelerations: OwnAccelerations, std_rad: float, constant: bool) -> OwnTilts:
    """Return what accelerations are that last for an episode each.

    Args:
        accelerations: The accelerations of episodes.
        std_rad: The size that they have as tilts [rad].
        constant: Whether flights tell them from forces that act during a part of each flight.
    """
    if (law := accelerations.law()) is not None:
        return OwnTilts("force", law)
    if constant and len(np.unique(accelerations.episode)) >= LIMITS.own_episodes:
        return OwnTilts("tilts")
    return OwnTilts("levelling") if std_rad < LIMITS.levelling_rad else OwnTilts("force", "episode")


def _bare(world: World) -> World:
    """Return the world without effects that push across gravity."""
    return replace(world, effects=tuple(active for active in world.effects if active.effect.name not in TILTS))


def _lasting_share(pieces: Segments, world: World, name: str, groups: Sequence[int]) -> float:
    """Return the share of what tilts of all pieces of flight explain that one tilt in each episode explains."""
    bare = _bare(world)
    variants = variants_of([Candidate(name, load_effect(name))], world.gravity[0, :1])
    linear = linearize(pieces, bare, variants, groups, robust=False)
    columns = linear.columns(variants[0].parameters)
    information, score = linear.information[:, columns][:, :, columns], linear.score[:, columns]
    width = np.array([linear.parameters[k].prior[1] for k in columns])
    single = [solved(m, g, width)[2:] for m, g in zip(information, score, strict=True)]
    units = [linear.episode == episode for episode in np.unique(linear.episode)]
    joint = [solved(information[own].sum(0), score[own].sum(0), width)[2:] for own in units]
    common, rank = (sum(part) for part in zip(*joint, strict=True))
    whole, size = (sum(part) for part in zip(*single, strict=True))
    if size < 2 * rank:
        return 0.0  # too few pieces to tell
    excess = max(whole - common - (size - rank), 0.0)
    lasting = max(common - rank, 0.0)
    return lasting / (lasting + excess) if lasting > 0 else 0.0


def own_tilt_step(
    prepared: Prepared, flight: Segments, world: World, candidates: Sequence[Candidate], slow: SlowErrors
) -> tuple[SelectionStep, World, Segments]:
    """Select a tilt of each episode's own.

    Args:
        prepared: The episodes, with the slow errors as part of their noise.
        flight: Segments with states fitted by the world.
        world: The world with the effects selected in flight, without a tilt.
        candidates: All candidates.
        slow: The slow errors.

    Returns:
        The step, the world with the mean tilt of all episodes, and the segments with states fitted by it.
    """
    names = _missing(world, candidates)
    std = slow.sway_m_s2(prepared.noise.position_m) / float(world.gravity[0].norm())
    tilted = with_added(world, load_effect(names[0]))
    found = refit([flight], tilted, base_parameters(tilted, "flight"))
    mean = {name: found.number(f"{names[0]}.{name}") for name in ("tilt_x", "tilt_y")}
    evidence = [_evidence(name, std, mean, slow.sway_evidence) for name in names]
    still = _still(found.segments[0])
    evidence += _own_winds(still, world, names[0], found, candidates, slow.sway_evidence)
    world, flight = _with_own(prepared, found.segments[0], found.world, names[0], std)
    return SelectionStep(tuple(evidence), tuple(evidence), True, own_std=std), world, flight


def _still(flight: Segments) -> Segments:
    """Return flights whose noise has no accelerations of their own."""
    noise = flight.noise_model
    return replace(flight, noise_model=noise._replace(position=noise.position._replace(sway=0.0)))


def _own_winds(
    flight: Segments, world: World, name: str, tilted: Refit, candidates: Sequence[Candidate], evidence: float
) -> list[Evidence]:
    """Return the evidence of a wind of each episode's own, if flights do not tell it from a tilt of each episode's own.

    Through a drag a steady wind pushes across gravity much as a tilt does, and the same in all of an episode's flights.

    Args:
        flight: Flights with states fitted beside one tilt for all episodes, without accelerations of their own.
        world: The world without a tilt.
        name: The tilt.
        tilted: The fit of one tilt for all episodes.
        candidates: All candidates.
        evidence: Twice the gain of the log-likelihood by tilts.
    """
    drags = [active.effect for active in world.effects if active.effect.name in DRAGS and not _own(active)]
    wind = next((one.effect for one in candidates if one.effect.name == "wind"), None)
    if not drags or wind is None:
        return []
    world = without_effects(tilted.world, name)  # with the drag as the fit beside a tilt has it
    episodes = np.array([item.episode for item in flight.items])
    start = dict.fromkeys(np.unique(episodes).tolist(), np.zeros(2))
    flight = fit_states(flight.in_world(world))
    _, by_tilt = values_of_each(load_effect(name), world, flight, episodes, start)
    winds, by_wind = values_of_each(wind, world, flight, episodes, start)
    sizes = [{"w_x": float(x), "w_y": float(y)} for x, y in winds.values()]
    worse = float(by_wind.sum() - by_tilt.sum()) + sum(prior_odds(wind, own) for own in sizes)
    if worse > THRESHOLDS.flight.alias_chi2:
        return []
    return [specific_evidence("wind@episode", np.array(list(winds.values())), evidence - worse, worse - evidence)]


def _with_own(prepared: Prepared, flight: Segments, world: World, name: str, std: float) -> tuple[World, Segments]:
    """Return the world with the likeliest tilt of each episode, and the flights in it.

    Args:
        prepared: The episodes, with the slow errors as part of their noise.
        flight: Segments with states fitted by the world.
        world: The world with the mean tilt of all episodes.
        name: The tilt.
        std: Standard deviation of the tilts between episodes [rad].
    """
    linear = linearize(_still(flight), world, (), prepared.groups, robust=False)
    numbers = ("tilt_x", "tilt_y")
    columns = linear.columns([f"{name}.{number}" for number in numbers])
    mean = next(active for active in world.effects if active.effect.name == name).values
    middle = np.array([float(mean[key][0]) for key in numbers])
    own = {}
    for episode in np.unique(linear.episode).tolist():
        mine = linear.episode == episode
        information = linear.information[mine][:, columns][:, :, columns].sum(0) + np.eye(2) / std**2
        step = np.linalg.solve(information, linear.score[mine][:, columns].sum(0))
        own[prepared.names[episode]] = middle + step
    others = tuple(active for active in world.effects if active.effect.name != name)
    world, flight = with_specific(replace(world, effects=others), flight, f"{name}@episode", middle, own)
    return world, fit_states(flight)


def _missing(world: World, candidates: Sequence[Candidate]) -> list[str]:
    """Return the names of the tilts that are candidates; none where the world has one already."""
    if any(active.effect.name in OWN_TILTS for active in world.effects if _own(active)):
        return []
    known = {candidate.effect.name for candidate in candidates}
    return [name for name in OWN_TILTS if name in known]


def _own(active: ActiveEffect) -> bool:
    """Return whether an effect has a value for each episode."""
    return any(parameter.shared == "episode" for parameter in active.effect.parameters)


def _evidence(name: str, std: float, mean: Mapping[str, tuple[float, float]], evidence: float) -> Evidence:
    """Return the evidence of a tilt of each episode's own.

    Args:
        name: Name of the tilt.
        std: Standard deviation between episodes [rad].
        mean: Mean over episodes [rad] and its standard error, by parameter.
        evidence: Twice the gain of the log-likelihood.
    """
    values = np.array([mean[key] for key in mean])
    # a variance is not below 0: half of the chance is at 0
    p_value = 0.5 * chi2_tail(evidence, 1)
    test = ScoreTest(
        statistic=evidence,
        dof=1,
        p_value=p_value,
        estimate=values[:, 0],
        covariance=np.diag(values[:, 1] ** 2),
        admissible=True,
    )
    return Evidence(
        candidate=Candidate(f"{name}@episode", load_effect(f"{name}@episode")),
        constants={},
        test=test,
        p_value=p_value,
        delta_bic=-evidence,
        numbers=dict(mean),
        spread=dict.fromkeys(mean, std),
    )
