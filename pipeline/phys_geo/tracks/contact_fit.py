"""The stage phys-geo: the numbers of the contact model from measured motion.

1. The noise of the tracks, given or estimated from them.
2. Where it is asked for, where the mass is (`mass_distribution.py`).
3. Initial states from each episode's warm-up, by the model itself.
4. A global search (adaptive importance sampling) on the open-loop error, many rollouts at once: what the model is for
   is to predict long unseen motion, and that error has several valleys. The estimate is the mean over the samples
   that predict about equally well, not the luckiest one.
5. With few episodes, multiple shooting from several starts, the search's among them: states and parameters together,
   and ties between short segments that give where the contact model misses something. With many episodes the search
   alone: their mean is smooth, and their scatter gives the intervals.

Where nothing touches anything in any episode there is no contact to search for: its numbers stay at their priors, and
only effects are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.capture import Capture
from ..datasets.ply import Splats
from ..datasets.progress import progress
from ..datasets.tracks import Track
from ..schemas import ContactParameters, Correlation, InputDataError, NotConvergedError, PhysConfig
from ..schemas import Parameter as FittedParameter
from .diagnosis.segments import world_for
from .diagnosis.usable import refuse_slow_times
from .effect_motions import fit_effect_motions
from .estimation.noise import estimate_noise
from .estimation.observations import Observations
from .estimation.search import Prior, SearchResult, episode_covariance, importance_search
from .estimation.shooting import Prior as ShotPrior
from .estimation.shooting import Shooting
from .estimation.tempering import tempered
from .estimation.warmup import estimate_states, flight_frames, warmup_frames
from .first_contacts import FirstContacts, bound_warnings, correlation_of, described
from .mass_distribution import fit_mass_distribution
from .physics.contact import restitution
from .physics.measured import measure
from .physics.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_TIME,
    GROUND_SHIFT,
    Parameter,
    apply_parameters,
    effect_parameters,
    mass_distribution,
)
from .physics.rotation import geodesic_angle
from .physics.world import State, World
from .threads import one_torch_thread

ERRORS_PER_EPISODE = 3.0
"""Independent errors in one episode's open-loop error; `docs/benchmarks.md` has how the intervals cover with it."""
MAX_SPAN_S = 0.8
"""Longer episodes are fitted on this much after their start: what follows a dozen impacts is noise to the fit."""
MAX_ROLLOUTS = 1200
"""Rollouts in one batch of the search."""
POPULATION = (24, 96)
"""Fewest and most samples in a generation, where the settings leave it open: about `MAX_ROLLOUTS` rollouts."""
LEAST_GENERATIONS = 2
"""Of a search that starts at the numbers of an earlier fit."""
OPEN_LOOP_TOLERANCE = 3.0
"""The shot's estimate may raise the open-loop error by this factor before the search's own is kept: a search over
three numbers bends them until one rough motion ends where it should."""
STARTS = ((0.5, 1.0), (1.0, 1.0), (1.7, 1.0), (1.0, 0.6), (1.0, 1.6))
"""Further starts of the shooting: friction and contact time are off by these factors from the priors' medians."""
BEST, SEVERAL_EPISODES = 3, 3
"""So many descents go on; from so many episodes on it starts at the search's result only, and one goes on: together
they have one valley."""
SHOT_ITERATIONS = 12
"""Least number of steps in each descent of the shooting."""
MODEL_EXCESS = 20.0
"""Where the ties do not hold down to what `shooting` allows, the contact model misses more than noise, and the errors
of one episode are not independent: what they tell shrinks by this times the ties' misfit (`tempered`). Chosen on the
built-in scenes fall 0 to 5 (MuJoCo's contact); data that the model explains have no misfit, and are not touched."""
MAX_EPISODES = 100
"""Of more episodes the search looks at so many, evenly spread: that is enough for four numbers, and it is what takes
long."""
ENOUGH_EPISODES = 8
"""From this many episodes on the search alone is used: their mean is smooth, and their scatter gives the intervals
without trusting the model."""

NEVER_TOUCHES = (
    "nothing touches anything in these episodes: the numbers of the contact stand at their priors; what can be fitted "
    "are effects that act in flight."
)


@dataclass(frozen=True)
class PhysicsFit:
    """What the stage found.

    contact, parameters: for `model.json`; ground_offset_m: fitted height of the ground, None where there
    is none; noise: position [m], rotation [rad]; record: for `fit.json`; warnings; mass, effects: where these were
    fitted; constants: of effects, `effect.constant` by name; starts: time [s] and state of the first frame of each
    episode, where shooting found it; collision: colliding spheres by body, where they were moved; tracks: what was
    found in videos, by episode and body; correlations: of the numbers of the contact, then of effects and of the mass.
    """

    contact: ContactParameters
    parameters: tuple[FittedParameter, ...]
    ground_offset_m: float | None
    noise: tuple[float, float]
    record: dict[str, Any]
    warnings: tuple[str, ...]
    mass: FirstContacts | None = None
    effects: FirstContacts | None = None
    constants: dict[str, float] = field(default_factory=dict)
    starts: dict[str, tuple[float, State]] = field(default_factory=dict)
    collision: dict[str, Splats] = field(default_factory=dict)
    tracks: dict[str, dict[str, Track]] = field(default_factory=dict)
    correlations: tuple[Correlation, ...] = ()


def track_episodes(capture: Capture, split: str) -> list[tuple[str, dict[str, Track]]]:
    """Return the episodes of a split that have tracks of a free body.

    Raises:
        InputDataError: If none has.
    """
    free = {body.name for body in capture.manifest.bodies if body.motion == "free"}
    episodes = [(name, capture.tracks(name)) for name in capture.episodes(split)]
    usable = [(name, tracks) for name, tracks in episodes if free & set(tracks)]
    if not usable:
        raise InputDataError(
            f"{capture.root}: none of the {len(episodes)} episodes of split '{split}' has a track of a free body.",
            "tracks/<episode>.csv with rows for a body whose motion is 'free'.",
            "add tracks, or fit from the videos: --supervise images.",
        )
    refuse_slow_times([t[b] for _, t in usable for b in free if b in t], str(capture.root))
    return usable


@one_torch_thread()
def fit_physics(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    config: PhysConfig,
    noise: tuple[float | None, float | None] = (None, None),
    begun: bool = False,
    groups: Mapping[str, str] | None = None,
) -> PhysicsFit:
    """Fit friction, contact time, damping ratio and ground height to measured tracks; where asked for, the mass too.

    Args:
        world: The world with its geometry and inertia.
        episodes: Name and tracks by body of each training episode.
        config: The stage's settings.
        noise: Known measurement noise (position [m], rotation [rad]); estimated where None.
        begun: Whether the world's contact numbers are those of an earlier fit: then the search starts there, and half
            as many generations do; else it starts at the middles of the priors.
        groups: Group of each episode that belongs to one, for effects with numbers of each group's own.

    Raises:
        NotConvergedError: If the rollouts diverge everywhere.
        InputDataError: If the tracks do not show where the mass is, and that is asked for.
    """
    _require_short_steps(config.step_s)
    free_tracks = [
        tracks[world.bodies[i].name] for _, tracks in episodes for i in world.free if world.bodies[i].name in tracks
    ]
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
    searched = [episodes[i] for i in chosen]
    observations = Observations.of(world, searched, [_span(tracks) for _, tracks in searched])
    flying = len(observations.free) == 1 and bool(
        flight_frames(world, observations)[observations.seen[..., 0] > 0].all()
    )
    estimated = estimate_noise(free_tracks, flying)
    sigma = (noise[0] or estimated[0], noise[1] or estimated[1])
    # the search over few episodes cannot tell the ground's height from the way of bouncing; shooting can
    height = world.ground_normal is not None and len(episodes) >= ENOUGH_EPISODES
    names = [*CONTACT_PARAMETERS, *([GROUND_SHIFT] if height else [])]
    start = [(p, _start(world, p) if begun else p.prior[0]) for p in names]
    mass: FirstContacts | None = None
    effects: FirstContacts | None = None
    if config.mass_distribution:
        mass = fit_mass_distribution(world, episodes, start, sigma)
        world = mass.world
    if effect_parameters(world):
        # flight needs no contact and no short steps
        effects = fit_effect_motions(
            world_for("flight", world, sigma[0]) if flying else world, episodes, [] if flying else start, sigma, groups
        )
        world = replace(effects.world, touching=world.touching, step_s=world.step_s)
        start = [(p, effects.along.get(p.name, value)) for p, value in start]
        if effects.ground is not None:  # rest shows it better than where rollouts end
            names = list(CONTACT_PARAMETERS)
            start = [(p, value) for p, value in start if p in names]
    observations = Observations.of(world, searched, [_span(tracks) for _, tracks in searched])
    warm = warmup_frames(world, observations, config.warmup_s)
    observations, _ = estimate_states(world, observations, warm, sigma)

    record: dict[str, Any] = {
        "episodes": len(episodes),
        "search_episodes": len(searched),
        "noise_estimated": {"position_m": estimated[0], "rotation_rad": estimated[1]},
    }
    if mass is not None:
        record["mass_distribution"] = mass.record
    if effects is not None:
        record["effects"] = effects.record
    starts: dict[str, tuple[float, State]] = {}
    if flying:
        found = _never_touching(world, names, sigma, _open_loop(world, observations, warm, names), record)
    else:
        floor = _noise_floor(world, observations, sigma)
        search = _search(world, observations, warm, start, floor, config, begun)
        if not math.isfinite(search.lowest):
            raise NotConvergedError(
                "phys-geo: every rollout of the search diverged.", todo="check the masses, the units and the step_s."
            )
        record |= {"search_open_loop_m": search.history, "search_effective_samples": search.effective_samples}
        best, covariance = search.mean, episode_covariance(search, search.mean, ENOUGH_EPISODES)
        if covariance is None:
            names, best, covariance, starts = _shot(
                world, searched, (observations, warm), names, search, sigma, config, record
            )
        found = physics_fit(world, names, best, covariance, sigma, record)
    return _completed(found, world, mass, effects, starts)


def _require_short_steps(step_s: float) -> None:
    longest = math.pi * CONTACT_TIME.bounds[0]
    if step_s > longest:
        raise InputDataError(
            f"phys-geo.step_s is {1e3 * step_s:g} ms: contacts of {1e3 * CONTACT_TIME.bounds[0]:g} ms, the "
            "shortest that the search looks at, would end within the step in which they begin.",
            f"up to {1e3 * longest:.2g} ms.",
        )


def _completed(
    found: PhysicsFit,
    world: World,
    mass: FirstContacts | None,
    effects: FirstContacts | None,
    starts: dict[str, tuple[float, State]],
) -> PhysicsFit:
    """Return the fit of the contact with what was found of effects and of the mass."""
    parts = [part for part in (effects, mass) if part is not None]
    more = [parameter for part in parts for parameter in part.parameters]
    if effects is not None and effects.ground is not None and world.ground_offset is not None:
        more.append(_absolute(effects.ground, float(world.ground_offset[0]) - effects.ground.estimate))
        found = replace(found, ground_offset_m=more[-1].estimate)
    known = [replace(GROUND_SHIFT, name="ground_offset_m"), *effect_parameters(world)]
    known += [*(p for i in world.free for p in mass_distribution(world.bodies[i].name, 1.0))]
    return replace(
        found,
        parameters=(*found.parameters, *more),
        correlations=(*found.correlations, *(block for part in parts for block in part.correlations)),
        warnings=(*found.warnings, *bound_warnings(known, more)),
        mass=mass,
        effects=effects,
        constants={} if effects is None else effects.constants,
        starts=starts,
    )


def _never_touching(
    world: World,
    names: list[Parameter],
    sigma: tuple[float, float],
    open_loop: Callable[[np.ndarray], np.ndarray],
    record: dict[str, Any],
) -> PhysicsFit:
    """Return a fit whose contact stands at the middles of its priors: a search would return the luck of its draws."""
    middle = np.array([p.encode(p.prior[0]) for p in names])
    record["search_open_loop_m"] = [float(open_loop(middle[None]).mean())]
    found = physics_fit(world, names, middle, np.diag([p.prior[1] ** 2 for p in names]), sigma, record)
    unseen = [warning for warning in found.warnings if "not observable" in warning]
    return replace(found, warnings=(NEVER_TOUCHES, *unseen))


def _start(world: World, parameter: Parameter) -> float:
    """Return a parameter's value in a world, within its bounds; the ground is not moved."""
    if parameter is GROUND_SHIFT:
        return 0.0
    low, high = parameter.bounds
    return min(max(float(getattr(world.contact, parameter.name)[0]), low), high)


def _noise_floor(world: World, observations: Observations, sigma: tuple[float, float]) -> float:
    """Return the displacement of a point on the surface [m] that the noise of the tracks alone looks like."""
    size = float(torch.stack([_surface_radius(world, index) for index in observations.free]).mean())
    return math.sqrt(3 * sigma[0] ** 2 + 3 * (size * sigma[1]) ** 2)


def _shot(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    batch: tuple[Observations, Tensor],
    names: list[Parameter],
    search: SearchResult,
    sigma: tuple[float, float],
    config: PhysConfig,
    record: dict[str, Any],
) -> tuple[list[Parameter], np.ndarray, np.ndarray, dict[str, tuple[float, State]]]:
    """Return names, estimate, covariance and starts by multiple shooting; the search's where that leads astray."""
    shown = "effects" in record and "ground_shift_m" in record["effects"]
    lacking = world.ground_normal is not None and GROUND_SHIFT not in names and not shown
    shot_names = [*names, GROUND_SHIFT] if lacking else names
    middle = np.array([p.encode(p.prior[0]) for p in shot_names])
    prior = ShotPrior(
        torch.as_tensor(middle),
        torch.tensor([p.prior[1] for p in shot_names], dtype=torch.float64),
        torch.tensor([p.limits for p in shot_names], dtype=torch.float64),
    )
    starts = [np.concatenate([search.mean, middle[len(search.mean) :]])]
    several = len(episodes) >= SEVERAL_EPISODES
    for friction, contact_time in () if several else STARTS:
        start = middle.copy()
        start[:2] += np.log([friction, contact_time])  # the first two of `CONTACT_PARAMETERS`
        starts.append(start)
    problem = Shooting.of(world, shot_names, episodes, [_span(tracks) for _, tracks in episodes], sigma, prior, several)
    best = 1 if several else BEST
    bar = progress(range(2 * len(starts) + best), "phys-geo: multiple shooting", total=2 * len(starts) + best)
    steps = iter(bar)
    shots = problem.fit(
        [torch.as_tensor(start) for start in starts],
        max(config.iterations, SHOT_ITERATIONS),
        best,
        lambda: next(steps, None),
    )
    bar.close()
    shot = shots[0]
    shared, covariance, growth = tempered(shot, prior, MODEL_EXCESS)
    cost = float(_open_loop(world, *batch, shot_names)(shared[None]).mean())
    keep = math.isfinite(shot.cost) and math.isfinite(cost) and cost <= OPEN_LOOP_TOLERANCE * search.lowest
    record |= {
        "shooting_costs": [one.cost for one in shots],
        "shooting_converged": shot.converged,
        "shooting_misfit": {"ties": shot.misfit, "frames": shot.chi2, "information_over": growth},
        "open_loop_m": {"search": search.lowest, "shooting": cost},
        "kept": "shooting" if keep else "search",
    }
    if not keep:
        return names, search.mean, search.covariance, {}
    starts_found = {
        name: (float(time), shot.state.at([row]))
        for row, (name, time) in enumerate(zip(batch[0].names, batch[0].times_s[:, 0], strict=True))
    }
    return shot_names, shared, covariance, starts_found


def _span(tracks: dict[str, Track]) -> tuple[float, float]:
    start = min(float(track.time_s[0]) for track in tracks.values())
    end = max(float(track.time_s[-1]) for track in tracks.values())
    return start - 1e-9, min(end, start + MAX_SPAN_S) + 1e-9


def _search(
    world: World,
    observations: Observations,
    warm: Tensor,
    start: Sequence[tuple[Parameter, float]],
    floor: float,
    config: PhysConfig,
    begun: bool,
) -> SearchResult:
    episodes, names = len(observations.names), [p for p, _ in start]
    generations = max(LEAST_GENERATIONS, config.generations // 2) if begun else config.generations
    prior = Prior(
        np.array([p.encode(p.prior[0]) for p in names]),
        np.array([p.prior[1] for p in names]),
        np.array([p.limits for p in names]),
    )
    bar = progress(range(generations), "phys-geo: search", total=generations)
    steps = iter(bar)

    def advance(_: int, cost: float) -> None:
        next(steps, None)
        bar.set_postfix_str(f"open loop {1e3 * cost:.1f} mm")

    result = importance_search(
        _open_loop(world, observations, warm, names),
        prior,
        seed=config.seed,
        population=config.population or _population(episodes),
        generations=generations,
        first=np.array([p.encode(value) for p, value in start]),
        errors=ERRORS_PER_EPISODE * episodes,
        floor=floor,
        on_generation=advance,
    )
    bar.close()
    return result


def _population(episodes: int) -> int:
    """Return how many samples a generation has."""
    rollouts = MAX_ROLLOUTS
    if SEVERAL_EPISODES <= episodes < ENOUGH_EPISODES:  # shooting from there on, which has one valley then
        rollouts //= 5
    return min(max(rollouts // episodes, POPULATION[0]), POPULATION[1])


def _open_loop(world: World, observations: Observations, warm: Tensor, names: list[Parameter]):
    """Return the open-loop error by episode: mean displacement [m] of a point on the surface after the warm-up."""
    after = observations.seen * (~warm)[..., None].to(observations.seen.dtype)
    frames = after.sum((1, 2)).clamp_min(1.0)
    size = torch.stack([_surface_radius(world, index) for index in observations.free])

    def costs(samples: np.ndarray) -> np.ndarray:
        chunk = max(1, MAX_ROLLOUTS // len(observations.names))
        parts = [one(samples[first : first + chunk]) for first in range(0, len(samples), chunk)]
        return np.concatenate(parts)

    def one(samples: np.ndarray) -> np.ndarray:
        repeats = len(samples)
        values = torch.as_tensor(samples).repeat_interleave(len(observations.names), 0)
        decoded = torch.stack([p.decode(values[:, k]) for k, p in enumerate(names)], -1)
        base = observations.state.repeat(repeats)
        drives = {name: drive.repeat(repeats) for name, drive in observations.drives.items()}
        with torch.no_grad():
            rollout = measure(
                apply_parameters(observations.world(world, repeats), names, decoded),
                base,
                observations.times_s.repeat(repeats, 1),
                drives,
            )
        free = list(observations.free)
        shift = rollout.position_m[:, :, free] - observations.position_m.repeat(repeats, 1, 1, 1)
        angle = geodesic_angle(rollout.quat_wxyz[:, :, free], observations.quat_wxyz.repeat(repeats, 1, 1, 1))
        turned = observations.turned.repeat(repeats, 1, 1)
        error = (shift.square().sum(-1) + (turned * angle * size).square()).sqrt()
        weight = after.repeat(repeats, 1, 1)
        return ((error * weight).sum((1, 2)) / frames.repeat(repeats)).view(repeats, -1).numpy()

    return costs


def _surface_radius(world: World, index: int) -> Tensor:
    """Return the mean distance of the colliding surface from the centre of mass [m]."""
    body = world.bodies[index]
    return ((body.centers[0] - body.com[0]).square().sum(-1).sqrt() + body.radii[0]).mean()


def physics_fit(
    world: World,
    names: list[Parameter],
    best: np.ndarray,
    covariance: np.ndarray,
    sigma: tuple[float, float],
    record: dict[str, Any],
) -> PhysicsFit:
    """Return the stage's result from an estimate and its covariance.

    Args:
        world: The world that was fitted.
        names: What was fitted; `GROUND_SHIFT`, if any, last.
        best: Estimate in fitted coordinates (P,).
        covariance: Of the same coordinates (P, P).
        sigma: Noise of the tracks (position [m], rotation [rad]).
        record: For `fit.json`.
    """
    std = np.sqrt(np.diag(covariance))
    fitted = [_parameter(p, z, s) for p, z, s in zip(names, best, std, strict=True)]
    warnings = bound_warnings(names, fitted)
    if GROUND_SHIFT in names and world.ground_offset is not None:
        fitted[-1] = _absolute(fitted[-1], float(world.ground_offset[0]))
    value = {p.name: p.estimate for p in fitted}
    contact = ContactParameters(**{key: value[key] for key in ("friction", "contact_time_s", "damping_ratio")})
    warnings += [f"{p.name} is not observable in these data; {p.note}." for p in fitted if p.state == "not_observable"]
    if record.get("episodes", 0) < ENOUGH_EPISODES:
        assumed = (
            f"that the errors of the contact model in one episode count as {ERRORS_PER_EPISODE:g} independent ones"
        )
        if record.get("kept") == "shooting":
            grown = record["shooting_misfit"]["information_over"]
            assumed = "that the contact model misses nothing in others that it does not miss in these"
            if grown >= 1.05:
                assumed = f"what the contact model misses in them makes their information {grown:.2g} times smaller"
        warnings.append(f"with fewer than {ENOUGH_EPISODES} episodes the intervals rest on an assumption: {assumed}")
    return PhysicsFit(
        contact,
        (*fitted, *_derived(world, names, best, covariance)),
        value.get("ground_offset_m"),
        sigma,
        record,
        tuple(warnings),
        correlations=(correlation_of([p.name for p in fitted], covariance),),
    )


def _absolute(shift: FittedParameter, offset: float) -> FittedParameter:
    """Return the ground's height where its shift was fitted."""
    assert shift.interval_95 is not None and shift.bounds is not None
    return shift.model_copy(
        update={
            "name": "ground_offset_m",
            "estimate": shift.estimate + offset,
            "interval_95": (shift.interval_95[0] + offset, shift.interval_95[1] + offset),
            "bounds": (shift.bounds[0] + offset, shift.bounds[1] + offset),
        }
    )


def _parameter(parameter: Parameter, coordinate: float, std: float) -> FittedParameter:
    centre, width = parameter.prior
    prior = f"normal{' in its logarithm' if parameter.logarithmic else ''} about {centre:g}, std {width:g}"
    return described(parameter, coordinate, std).model_copy(update={"prior": prior})


def _derived(world: World, names: list[Parameter], best: np.ndarray, covariance: np.ndarray) -> list[FittedParameter]:
    """Return restitution, and stiffness and damping of a single contact below the centre of mass, by first order."""
    index = {parameter.name: k for k, parameter in enumerate(names)}
    tau, zeta = index["contact_time_s"], index["damping_ratio"]
    mass = float(world.bodies[world.free[0]].mass[0])
    formulas = {
        "restitution": ("1", lambda z: restitution(z[zeta].exp())),
        "stiffness_n_m": ("N/m", lambda z: mass / z[tau].exp().square()),
        "damping_n_s_m": ("N s/m", lambda z: 2 * z[zeta].exp() * mass / z[tau].exp()),
    }
    derived = []
    for name, (unit, formula) in formulas.items():
        z = torch.tensor(best, dtype=torch.float64, requires_grad=True)
        value = formula(z)
        (slope,) = torch.autograd.grad(value, z)
        std = math.sqrt(float(slope.numpy() @ covariance @ slope.numpy()))
        estimate = float(value.detach())
        reach = math.exp(min(1.96 * std / estimate, 30.0))  # first order in the logarithm: they are positive
        note = (
            "speed ratio of a head-on impact" if name == "restitution" else f"of one contact that carries {mass:g} kg"
        )
        derived.append(
            FittedParameter(
                name=name,
                unit=unit,
                estimate=estimate,
                std_error=std,
                # no impact gives back more than it took
                interval_95=(estimate / reach, min(estimate * reach, 1.0 if name == "restitution" else math.inf)),
                state="derived",
                note=note,
            )
        )
    return derived
