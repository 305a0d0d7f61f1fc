"""The stage phys-geo on measured tracks: contact parameters, and where asked for effects and the mass distribution.

1. The noise of the tracks, given or estimated from them.
2. The damping of a ball from the heights on both sides of its bounces (`segments/impacts`): the search takes
   a missing drag, a late rebound and the prior for restitution.
3. What held-out tosses ask for beside the contact (`part_choice.py`): where it is chosen or asked for, the mass
   distribution (`inertia_fit.py`), then the effects of the world (`effect_fit.py`), a scale of lengths among them.
4. Initial states from each episode's warm-up, fitted with the model itself.
5. A global search (adaptive importance sampling) on the open-loop error, many rollouts at once (`open_loop_search.py`):
   the model's purpose is to predict long unseen motion, and this error has several minima. The estimate is the mean
   over the samples that predict about equally well, not the best single sample.
6. With few episodes, multiple shooting from several starts, the search's among them (`contact_shooting.py`): states and
   parameters together, with soft ties between short segments that absorb errors of the contact model. With many
   episodes the search alone: their mean error is smooth, and their scatter gives the intervals.
7. Where tracks of driven bodies carry forces, what these say in addition (`force_fit.py`).

If nothing touches anything in any episode, there is no contact to search for: the contact parameters stay at their
priors, and only effects are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ....datasets.capture.tracks import Episode, Track
from ....datasets.io.progress import note
from ....schemas import FitChoice, InputDataError, PhysConfig
from ....schemas.materials import of_pair
from ...optimization.importance_sampling import SearchResult, episode_covariance
from ...physics.chains.parameters import chain_parameters
from ...physics.effects import ActiveEffect, load_effect
from ...physics.effects.recording import no_recording
from ...physics.pair_laws import laws_in_use
from ...physics.paper_law import PaperLaw
from ...physics.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_TIME,
    FRICTION,
    GROUND_SHIFT,
    Parameter,
    apply_parameters,
    contact_parameters,
    contact_values,
    effect_parameters,
    gap_parameters,
    mass_distribution,
)
from ...physics.world import World
from ...runtime.resources import one_torch_thread
from ...segments.center_of_mass import as_one_body
from ...segments.first_contact_fit import EffectEstimate
from ...segments.fitted_parameters import bound_warnings
from ...segments.flight_check import flights_contradict
from ...segments.impacts.restitution import RestitutionFit, restitution_of
from ...segments.segments import world_for
from ...trajectories.initial_state import estimate_states, flight_frames, warmup_frames
from ...trajectories.observations import Observations
from ...trajectories.residuals import STATE_SIZE
from ...trajectories.segmentation import whole_episodes
from ...trajectories.track_noise import Noise, estimate_noise
from ..effects.effect_fit import fit_effects
from .bounce_damping import damping_of, with_bounces
from .contact_result import (
    ContactEstimate,
    FitRecord,
    PhysicsFit,
    absolute_ground,
    physics_fit,
    with_damping,
)
from .contact_shooting import GLIDING_TOLERANCE, OPEN_LOOP_TOLERANCE, ShootingEpisodes, shoot_contact
from .driven_joints import fit_driven_joints
from .earlier_estimates import EarlierEstimates
from .force_fit import with_forces
from .glides import fit_gliding_joints
from .inertia_fit import MASS_PARTS, fit_mass_distribution, mass_parameters
from .joint_fit import fit_joints
from .measured_forces import measured_forces
from .open_loop_search import ENOUGH_EPISODES, SearchBatch, friction_on_ice, open_loop_errors, search_contact
from .part_choice import SCALE, asked_parts, choose_parts, without_contradicted, without_number

MAX_SPAN_S = 0.8
"""Maximum duration of an episode in the fit, from its start [s]: after a dozen impacts the motion carries no
information."""
MAX_EPISODES = 100
"""Maximum number of episodes in the search, evenly spread: enough for four parameters, and the slowest step of the
fit."""

SEARCHES = 6
"""Maximum number of searches of episodes that begin in contact: each brings a friction a third of the way or more."""

NEVER_TOUCHES = (
    "nothing touches anything in these episodes: the contact parameters keep their {} values; only effects that act "
    "in flight can be fitted. Impacts and slides would reveal the others."
)
"""Warning for a fit in which no body touches anything; the values are prior or earlier ones."""


@one_torch_thread()
def fit_physics(
    world: World,
    episodes: Sequence[Episode],
    config: PhysConfig,
    noise: tuple[float | None, float | None] = (None, None),
    warm_started: bool = False,
    groups: Mapping[str, str] | None = None,
    earlier: EarlierEstimates | None = None,
    medians: Mapping[str, float] | None = None,
    force_std_n: float | None = None,
) -> PhysicsFit:
    """Fit contact parameters and ground height to measured tracks, and effects and mass distribution where asked for.

    The contact parameters are friction, contact time and damping ratio.

    Args:
        world: The world with its geometry and inertia.
        episodes: Name and tracks by body of each training episode.
        config: The stage's settings.
        noise: Known measurement noise (position [m], rotation [rad]); estimated where None.
        warm_started: Whether the world's contact parameters come from an earlier fit: the search then starts there
            with half as many generations; otherwise it starts at the medians of the priors.
        groups: Group of each episode that belongs to one, for effects with group-specific parameters.
        earlier: What an earlier fit found: kept where these episodes do not observe it.
        medians: Medians of the priors of contact parameters that are known better than usual, by name.
        force_std_n: Noise of a component of the measured forces of driven bodies [N]; estimated where None.

    Raises:
        NotConvergedError: If the rollouts diverge everywhere.
        InputDataError: If the mass distribution is asked for, and the tracks do not identify it.
    """
    _require_short_steps(config.step_s)
    note(f"phys-geo: motion of {len(episodes)} episode{'' if len(episodes) == 1 else 's'}")
    with no_recording(active.effect for active in world.effects):
        data = _FitData.of(world, episodes, noise)
        earlier = earlier or EarlierEstimates()
        ready = _fitted_before(world, data, config, warm_started, groups, earlier, medians or {})
        return _completed(_found(ready, data, config, warm_started, earlier, force_std_n), ready)


def _found(
    ready: _Ready,
    data: _FitData,
    config: PhysConfig,
    warm_started: bool,
    earlier: EarlierEstimates,
    force_std_n: float | None,
) -> PhysicsFit:
    """Return the fit of the contact parameters, after the fits of mass distribution and effects."""
    batch = _with_initial_states(ready.world, data, config.warmup_s)
    record = FitRecord(
        episodes=len(data.episodes),
        search_episodes=len(data.searched),
        noise_estimated=data.noise_estimated,
        mass_distribution=None if ready.mass is None else ready.mass.record,
        effects=None if ready.effects is None else ready.effects.record,
        choice=ready.choice,
        bounces=None if data.bounces is None else data.bounces.to_json(),
    )
    if data.airborne:
        return _never_touching(ready, batch, data, record, earlier)
    driven = fit_driven_joints(ready.world, data.searched, data.noise, force_std_n)
    forces = measured_forces(ready.world, data.searched, batch.observations, force_std_n)
    gliding = None if forces or driven is not None else fit_gliding_joints(ready.world, data.searched, data.noise)
    known = ready
    if driven is not None:
        known = replace(ready, world=driven.world(ready.world), start=driven.narrowed(ready.start))
    elif gliding is not None:
        known = replace(ready, start=gliding.told().narrowed(ready.start))
    estimate, record = _contact_estimate(known, data, batch, config, warm_started, record)
    if data.bounces is not None:
        estimate = with_damping(estimate, damping_of(data.bounces, ready.world, estimate.contact_time_s))
    if driven is not None:
        estimate = driven.put_in(estimate, ready.parameters)
        record = replace(record, forces=driven.record)
    elif gliding is not None:
        estimate = gliding.leave_open(gliding.told().put_in(estimate, ready.parameters))
        record = replace(record, glides=gliding.record)
    elif forces:
        note("phys-geo: measured forces")
        estimate, told = with_forces(ready.world, estimate, forces, batch.observations, batch.start_cov)
        record = replace(record, forces=told | {"through_law": bool(ready.world.chains)})
    estimate = estimate.without([p.name for p in gap_parameters(ready.world)])
    return physics_fit(known.world, earlier.kept_in(known.world, estimate), data.noise, record)


def _require_short_steps(step_s: float) -> None:
    """Refuse a step that is too long for the shortest contact of the search."""
    longest = math.pi * CONTACT_TIME.bounds[0]
    if step_s > longest:
        raise InputDataError(
            f"phys-geo.step_s is {1e3 * step_s:g} ms: contacts of {1e3 * CONTACT_TIME.bounds[0]:g} ms, the "
            "shortest in the search, would end within the step in which they begin.",
            f"up to {1e3 * longest:.2g} ms.",
            "pass a shorter step with --set phys-geo.step_s=SECONDS, or leave it at its default.",
        )


@dataclass(frozen=True, kw_only=True)
class _FitData:
    """Episodes of a fit, their noise, and whether they contain contact."""

    episodes: Sequence[Episode]
    """Name and tracks by body of each training episode."""
    searched: Sequence[Episode]
    """Episodes of the search: at most `MAX_EPISODES`, evenly spread."""
    spans: Sequence[tuple[float, float]]
    """Start and end of the part of each searched episode that is fitted [s]."""
    noise_estimated: Noise
    """Noise estimated from the tracks: position [m], rotation [rad]."""
    noise: Noise
    """Noise that the fit assumes, given or estimated: position [m], rotation [rad]."""
    bounces: RestitutionFit | None
    """Restitution of the bounces of a ball, where its tracks have some and the law has a damping ratio for it."""
    airborne: bool
    """Whether the only free body, or jointed bodies and all others touch nothing in any of the frames."""

    @staticmethod
    def of(world: World, episodes: Sequence[Episode], noise: tuple[float | None, float | None]) -> _FitData:
        """Choose the episodes of the search, and estimate the noise where it is not given."""
        free_tracks = [
            tracks[world.bodies[i].name]
            for _, tracks in episodes
            for i in world.tracked
            if world.bodies[i].name in tracks
        ]
        chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
        searched = [episodes[i] for i in chosen]
        spans = [_span(tracks) for _, tracks in searched]
        observations = Observations.of(world, searched, spans)
        airborne = (len(observations.free) == 1 or bool(world.chains)) and bool(
            flight_frames(world, observations)[observations.seen[..., 0] > 0].all()
        )
        estimated = estimate_noise(free_tracks, airborne)
        return _FitData(
            episodes=episodes,
            searched=searched,
            spans=spans,
            noise_estimated=estimated,
            noise=Noise(noise[0] or estimated[0], noise[1] or estimated[1]),
            bounces=None
            if airborne or world.chains or len(laws_in_use(world).laws) > 1 or isinstance(world.contact, PaperLaw)
            else restitution_of(world, whole_episodes(world, episodes)),
            airborne=airborne,
        )


@dataclass(frozen=True, kw_only=True)
class _Ready:
    """The world for the search, after the fits of mass distribution and effects."""

    world: World
    """The world with the fitted mass distribution and effects."""
    start: Sequence[tuple[Parameter, float]]
    """Contact parameters that are searched, and where the search starts."""
    mass: EffectEstimate | None
    """Mass distribution, where it was fitted."""
    effects: EffectEstimate | None
    """Effects, where they were fitted."""
    choice: FitChoice | None
    """What was chosen to be fitted."""

    @property
    def parameters(self) -> list[Parameter]:
        """Contact parameters that are searched."""
        return [parameter for parameter, _ in self.start]

    @property
    def ground_known(self) -> bool:
        """Whether the fit of the effects found the height of the ground."""
        return self.effects is not None and self.effects.ground is not None


def _fitted_before(
    world: World,
    data: _FitData,
    config: PhysConfig,
    warm_started: bool,
    groups: Mapping[str, str] | None,
    earlier: EarlierEstimates,
    medians: Mapping[str, float],
) -> _Ready:
    """Fit mass distribution and effects, which short windows identify better than the open-loop error."""
    # with few episodes the search cannot separate the ground's height from the bouncing; shooting can
    height = world.ground_normal is not None and len(data.episodes) >= ENOUGH_EPISODES
    contact = _of_seen_pairs(world, contact_parameters(world, medians), data.episodes)
    gaps = [] if data.airborne else gap_parameters(world)
    names = [*contact, *chain_parameters(world), *gaps, *([GROUND_SHIFT] if height else [])]
    start = [(p, _start(world, p) if warm_started else p.prior[0]) for p in names]
    world, start = with_bounces(world, start, data.bounces)
    world, mass, choice = _with_chosen_parts(world, data, config, start)
    effects: EffectEstimate | None = None
    if effect_parameters(world):
        # flight needs no contact and no short steps
        at = world_for("flight", world, data.noise.position_m) if data.airborne else world
        # a scale alone is known far better than it matters from the episodes of the search
        only_scale = [active.effect.name for active in world.effects] == [SCALE]
        episodes = data.searched if only_scale else data.episodes
        if world.chains:
            effects = _effects_on_whole(at, episodes, data.noise, groups, earlier)
        else:
            effects = _effects_beside(at, episodes, [] if data.airborne else start, data.noise, groups, earlier)
    if effects is not None:
        world = replace(effects.world, touching=world.touching, step_s=world.step_s)
        start = [(p, effects.contact_start.get(p.name, value)) for p, value in start]
        if effects.ground is not None:  # bodies at rest identify it better than the ends of rollouts
            start = [(p, value) for p, value in start if p is not GROUND_SHIFT]
    return _Ready(world=world, start=start, mass=mass, effects=effects, choice=choice)


def _effects_beside(
    world: World,
    episodes: Sequence[Episode],
    along: Sequence[tuple[Parameter, float]],
    noise: Noise,
    groups: Mapping[str, str] | None,
    earlier: EarlierEstimates,
) -> EffectEstimate | None:
    """Return the effects, fitted beside those that were found before and are not observed now; None if none is left."""
    note(f"phys-geo: {', '.join(active.effect.name for active in world.effects)}")
    found = fit_effects(world, episodes, along, noise, groups)
    lost = earlier.lost_effects(world, found)
    if not lost:
        return found
    return fit_effects(world, episodes, along, noise, groups, lost) if len(lost) < len(world.effects) else None


def _effects_on_whole(
    world: World,
    episodes: Sequence[Episode],
    noise: Noise,
    groups: Mapping[str, str] | None,
    earlier: EarlierEstimates,
) -> EffectEstimate | None:
    """Return the effects on a jointed body, fitted to the flights of the centre of mass of its links."""
    alone, flown = as_one_body(world, episodes, noise, world.source or "the capture")
    if not flown:
        raise InputDataError(
            f"'{alone.bodies[0].name}' flies in no episode without touching anything.",
            "flights: effects on jointed bodies are fitted to their centre of mass.",
            "leave --effects out, or add throws.",
        )
    own = estimate_noise([track for _, tracks in flown for track in tracks.values()])
    found = _effects_beside(alone, flown, [], own, groups, earlier)
    return None if found is None else replace(found, world=replace(world, effects=found.world.effects))


def _with_chosen_parts(
    world: World, data: _FitData, config: PhysConfig, start: Sequence[tuple[Parameter, float]]
) -> tuple[World, EffectEstimate | None, FitChoice | None]:
    """Return the world with the mass distribution and an unfitted scale that are chosen or asked for, with the choice.

    Args:
        world: The world.
        data: The episodes.
        config: The stage's settings.
        start: Contact parameters, and their start.
    """
    choice = None if data.airborne or world.chains else choose_parts(world, data.episodes, data.noise, config)
    parts = {*asked_parts(config), *(() if choice is None else choice.chosen)}
    mass: EffectEstimate | None = None
    wanted = [part for part in MASS_PARTS if part in parts]
    while wanted:
        mass = fit_mass_distribution(world, data.episodes, start, data.noise, wanted)
        unasked = [part for part in wanted if part not in asked_parts(config)]
        if choice is not None:
            given = {p.name: value for p, value in mass_parameters(world, wanted)}
            choice = without_number(choice, mass.parameters, given)
            kept = [part for part in wanted if part in {*asked_parts(config), *choice.chosen}]
            if kept != wanted:
                wanted, mass = kept, None
                continue
        if not unasked or choice is None or not flights_contradict(world, mass.world, data.episodes, data.noise):
            world = mass.world
            break
        choice, mass = without_contradicted(choice, unasked[-1]), None
        wanted.remove(unasked[-1])
    if SCALE in parts and all(active.effect.name != SCALE for active in world.effects):
        scale = ActiveEffect.of(load_effect(SCALE), {}, world.gravity)
        world = replace(world, effects=(*world.effects, scale))
    return world, mass, choice


def _with_initial_states(world: World, data: _FitData, warmup_s: float) -> SearchBatch:
    """Return the searched episodes with initial states from their warm-up."""
    observations = Observations.of(world, data.searched, data.spans)
    warm = warmup_frames(world, observations, warmup_s)
    observations, solution = estimate_states(world, observations, warm, data.noise)
    return SearchBatch(observations, warm, solution.state_cov)


def _searched(
    ready: _Ready, data: _FitData, batch: SearchBatch, config: PhysConfig, warm_started: bool, glides: Tensor
) -> tuple[SearchBatch, SearchResult]:
    """Return what the search finds, and the episodes with the states from which it did.

    Where bodies slide from the first frame on (`glides`), their velocities after the warm-up depend on the friction
    with which they were estimated: they are estimated anew with the one that is found, until they stay.
    """
    search = search_contact(ready.world, batch, ready.start, data.noise, config, warm_started)
    for _ in range(SEARCHES - 1 if glides.any() else 0):
        values = [p.decode(torch.tensor([value])) for (p, _), value in zip(ready.start, search.mean, strict=True)]
        names = [p for p, _ in ready.start]
        again = _with_initial_states(
            apply_parameters(ready.world, names, torch.stack(values, -1)), data, config.warmup_s
        )
        if not _moved(batch, again, glides):
            break
        batch = again
        start = [(p, float(value)) for p, value in zip(names, values, strict=True)]
        search = search_contact(ready.world, batch, start, data.noise, config, warm_started=True, near=True)
    return batch, search


def _glides(ready: _Ready, batch: SearchBatch) -> Tensor:
    """Return whether in each episode (B,) bodies slide or roll from its first frame on, and nothing drives them."""
    begins_in_contact = ~flight_frames(ready.world, batch.observations)[:, 0]
    return begins_in_contact & (not (ready.world.chains or batch.observations.drives))


def _on_ice(
    ready: _Ready, data: _FitData, batch: SearchBatch, config: PhysConfig, glides: Tensor
) -> tuple[_Ready, SearchBatch]:
    """Return the start at a friction far below that of usual materials, where bodies that glide ask for it."""
    friction = friction_on_ice(ready.world, batch, ready.start) if glides.any() else None
    if friction is None:
        return ready, batch
    start = [
        (replace(p, prior=(friction, p.prior[1])), friction) if p.name == FRICTION.name else (p, value)
        for p, value in ready.start
    ]
    values = torch.tensor([[value for _, value in start]]).to(ready.world.gravity)
    world = apply_parameters(ready.world, [p for p, _ in start], values)
    return replace(ready, start=start), _with_initial_states(world, data, config.warmup_s)


def _moved(before: SearchBatch, after: SearchBatch, glides: Tensor) -> bool:
    """Return whether the speed of an episode of those that glide is another one, beyond its standard error.

    What changes across the way, into the ground or a surface and out of it, is not by friction.
    """
    free = list(after.observations.free)
    first, second = (one.observations.state.velocity_m_s[glides][:, free] for one in (before, after))
    columns = torch.tensor([STATE_SIZE * column + 6 + axis for column in range(len(free)) for axis in range(3)])
    covariance = after.start_cov[glides][:, columns][:, :, columns].unflatten(1, (len(free), 3)).unflatten(3, (-1, 3))
    own = torch.stack([covariance[:, k, :, k] for k in range(len(free))], 1)
    way = torch.nn.functional.normalize(second, dim=-1)
    variance = (way[..., None, :] @ own @ way[..., None]).squeeze(-1).squeeze(-1)
    return bool((((second - first) * way).sum(-1).abs() > variance.clamp_min(0).sqrt()).any())


def _contact_estimate(
    ready: _Ready, data: _FitData, batch: SearchBatch, config: PhysConfig, warm_started: bool, record: FitRecord
) -> tuple[ContactEstimate, FitRecord]:
    """Return the contact parameters by the search, refined by shooting where there are few episodes."""
    glides = _glides(ready, batch)
    ready, batch = _on_ice(ready, data, batch, config, glides)
    batch, search = _searched(ready, data, batch, config, warm_started, glides)
    record = replace(record, search_open_loop_m=search.history, search_effective_samples=search.effective_samples)
    covariance = episode_covariance(search, ENOUGH_EPISODES)
    if covariance is not None:
        estimate = ContactEstimate(
            parameters=ready.parameters, values=search.mean, covariance=covariance, spread=search.covariance
        )
        return estimate, record
    episodes = ShootingEpisodes(episodes=data.searched, spans=data.spans, batch=batch)
    tolerance = GLIDING_TOLERANCE if glides.all() else OPEN_LOOP_TOLERANCE
    estimate, shooting = shoot_contact(
        ready.world, episodes, search, ready.parameters, ready.ground_known, data.noise, config, tolerance
    )
    return estimate, replace(record, shooting=shooting)


def _never_touching(
    ready: _Ready, batch: SearchBatch, data: _FitData, record: FitRecord, earlier: EarlierEstimates
) -> PhysicsFit:
    """Return a fit with earlier contact parameters, or at their priors; a search would return the scatter of draws.

    Jointed bodies move by what acts in their joints, which is fitted.
    """
    names = ready.parameters
    values, covariance = np.array([p.encode(p.prior[0]) for p in names]), np.diag([p.prior[1] ** 2 for p in names])
    joints = chain_parameters(ready.world)
    if joints:
        note("phys-geo: joints")
        rows = [names.index(parameter) for parameter in joints]
        values[rows], covariance[np.ix_(rows, rows)] = fit_joints(
            ready.world, data.searched, data.spans, joints, data.noise
        )
    errors = open_loop_errors(ready.world, batch.observations, batch.warm, names)
    record = replace(record, search_open_loop_m=[float(errors(values[None]).mean())])
    estimate = ContactEstimate(parameters=names, values=values, covariance=covariance)
    estimate = earlier.kept_in(ready.world, estimate)
    found = physics_fit(ready.world, estimate, data.noise, record)
    unseen = any(parameter.state == "not_observable" for parameter in found.parameters)
    values = "prior" if not estimate.kept else "earlier or prior" if unseen else "earlier"
    of_joints = [parameter for parameter in found.parameters if parameter.name in {joint.name for joint in joints}]
    return replace(found, warnings=(NEVER_TOUCHES.format(values), *bound_warnings(joints, of_joints)))


def _completed(found: PhysicsFit, ready: _Ready) -> PhysicsFit:
    """Return the fit of the contact, completed by the fits of effects and mass distribution."""
    world, mass, effects = ready.world, ready.mass, ready.effects
    parts = [part for part in (effects, mass) if part is not None]
    more = [parameter for part in parts for parameter in part.parameters]
    if effects is not None and effects.ground is not None and world.ground_offset is not None:
        more.append(absolute_ground(effects.ground, float(world.ground_offset[0]) - effects.ground.estimate))
        found = replace(found, ground_offset_m=more[-1].estimate)
    return replace(
        found,
        parameters=(*found.parameters, *more),
        correlations=(*found.correlations, *(block for part in parts for block in part.correlations)),
        warnings=(*found.warnings, *bound_warnings(_known_parameters(world), more)),
        mass=mass,
        effects=effects,
        constants={} if effects is None else effects.constants,
    )


def _known_parameters(world: World) -> list[Parameter]:
    """Return the ground's height and the parameters of effects and of the mass distribution that a world can have."""
    return [
        replace(GROUND_SHIFT, name="ground_offset_m"),
        *effect_parameters(world),
        *(p for i in world.free for p in mass_distribution(world.bodies[i].name, 1.0)),
    ]


def _start(world: World, parameter: Parameter) -> float:
    """Return the value of a parameter in a world, within its bounds; 0 for the shift of the ground."""
    if parameter is GROUND_SHIFT:
        return 0.0
    low, high = parameter.bounds
    return min(max(contact_values(world).get(parameter.name, parameter.prior[0]), low), high)


def _of_seen_pairs(world: World, parameters: Sequence[Parameter], episodes: Sequence[Episode]) -> list[Parameter]:
    """Return the contact parameters of pairs of materials whose bodies are together in an episode."""
    tracked = [set(tracks) for _, tracks in episodes]
    moving = {body.name for body in world.bodies if body.motion != "fixed"}
    seen = set()
    for a, b in world.pairs:
        bodies = {world.bodies[index].name for index in (a, b) if index >= 0} & moving
        if any(bodies <= names for names in tracked):
            seen |= {of_pair(parameter.name, world.materials_of(a, b)) for parameter in CONTACT_PARAMETERS}
    return [parameter for parameter in parameters if parameter.name in seen or not world.pairs]


def _span(tracks: dict[str, Track]) -> tuple[float, float]:
    """Return start and end [s] of the part of an episode that is fitted."""
    start = min(float(track.time_s[0]) for track in tracks.values())
    end = max(float(track.time_s[-1]) for track in tracks.values())
    return start - 1e-9, min(end, start + MAX_SPAN_S) + 1e-9
