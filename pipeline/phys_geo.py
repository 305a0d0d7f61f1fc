"""The stage phys-geo: the numbers of the contact model from measured motion.

1. The noise of the tracks, given or estimated from them.
2. Where it is asked for, where the mass is (`mass_distribution.py`).
3. Initial states from each episode's warm-up, by the model itself.
4. A global search (adaptive importance sampling) on the open-loop error, many rollouts at once: what the model is for
   is to predict long unseen motion, and that error has several valleys. The estimate is the mean over the samples
   that predict about equally well, not the luckiest one.
5. Where a few episodes are explained down to their noise, Levenberg-Marquardt with exact forward-mode derivatives,
   states and parameters together: the sharper estimate if the model is right, and misleading if it is not. With many
   episodes, their scatter gives the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.capture import Capture
from ..datasets.progress import progress
from ..datasets.tracks import Track
from ..schemas import ContactParameters, InputDataError, NotConvergedError, PhysConfig
from ..schemas import Parameter as FittedParameter
from .estimation.least_squares import Solution, minimise
from .estimation.noise import estimate_noise
from .estimation.observations import Observations
from .estimation.search import Prior, SearchResult, episode_covariance, importance_search
from .estimation.trajectory import TrajectoryResiduals, state_prior
from .estimation.warmup import estimate_states, flight_frames, warmup_frames
from .first_contacts import AFTER_S, CONTACT_S, FirstContacts, bound_warnings, described, fit_first_contacts
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

ERRORS_PER_EPISODE = 3.0
"""Independent errors in one episode's open-loop error; `docs/benchmarks.md` has how the intervals cover with it."""
MAX_SPAN_S = 0.8
"""Longer episodes are fitted on this much after their start: what follows a dozen impacts is noise to the fit."""
MAX_ROLLOUTS = 1200
"""Rollouts in one batch of the search."""
POPULATION = (24, 96)
"""Fewest and most samples in a generation, where the settings leave it open: about `MAX_ROLLOUTS` rollouts."""
WORTH_REFINING = 2.0
"""Up to this many times the error that noise alone makes, a motion may be explained by the model, and is refined."""
EXPLAINED = 0.5
"""It is explained if after contact the model errs by no more than this share of the noise beyond the noise."""
WITHIN_REACH = 2.0
"""After the first steps of the refinement the model may err by this many times what `EXPLAINED` allows; beyond it, more
steps would not explain the motion either, and they are what takes long."""
OPEN_LOOP_TOLERANCE = 1.5
"""The refined estimate may raise the open-loop error by this factor before the search's own is kept."""
MAX_EPISODES = 100
"""Of more episodes the search looks at so many, evenly spread: that is enough for four numbers, and it is what takes
long."""
ENOUGH_EPISODES = 8
"""From this many episodes on the search alone is used: their mean is smooth, and their scatter gives the intervals
without trusting the model."""


@dataclass(frozen=True)
class PhysicsFit:
    """What the stage found.

    contact, parameters: for `model.json`; ground_offset_m: fitted height of the ground, None where there
    is none; noise: position [m], rotation [rad]; record: for `fit.json`; warnings; mass, effects: where these were
    fitted; constants: of effects, `effect.constant` by name.
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
    return usable


def fit_physics(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    config: PhysConfig,
    noise: tuple[float | None, float | None] = (None, None),
) -> PhysicsFit:
    """Fit friction, contact time, damping ratio and ground height to measured tracks; where asked for, the mass too.

    Args:
        world: The world with its geometry and inertia; its contact law is the start of the search.
        episodes: Name and tracks by body of each training episode.
        config: The stage's settings.
        noise: Known measurement noise (position [m], rotation [rad]); estimated where None.

    Raises:
        NotConvergedError: If the rollouts diverge everywhere.
        InputDataError: If the tracks do not show where the mass is, and that is asked for.
    """
    longest = math.pi * CONTACT_TIME.bounds[0]
    if config.step_s > longest:
        raise InputDataError(
            f"phys-geo.step_s is {1e3 * config.step_s:g} ms: contacts of {1e3 * CONTACT_TIME.bounds[0]:g} ms, the "
            "shortest that the search looks at, would end within the step in which they begin.",
            f"up to {1e3 * longest:.2g} ms.",
        )
    free_tracks = [
        tracks[world.bodies[i].name] for _, tracks in episodes for i in world.free if world.bodies[i].name in tracks
    ]
    estimated = estimate_noise(free_tracks)
    sigma = (noise[0] or estimated[0], noise[1] or estimated[1])
    # few episodes cannot tell the ground's height from the way of bouncing, and the manifest gives the height
    height = world.ground_normal is not None and len(episodes) >= ENOUGH_EPISODES
    names = [*CONTACT_PARAMETERS, *([GROUND_SHIFT] if height else [])]
    mass: FirstContacts | None = None
    effects: FirstContacts | None = None
    if config.mass_distribution:
        mass = fit_mass_distribution(world, episodes, [(p, p.prior[0]) for p in names], sigma)
        world = mass.world
    if effect_parameters(world):
        effects = _fit_effects(world, episodes, names, sigma)
        world = effects.world
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
    searched = [episodes[i] for i in chosen]
    observations = Observations.of(world, searched, [_span(tracks) for _, tracks in searched])
    warm = warmup_frames(world, observations, config.warmup_s)
    observations, _ = estimate_states(world, observations, warm, sigma)

    floor = _noise_floor(world, observations, sigma)
    search = _search(world, observations, warm, names, floor, config)
    if not math.isfinite(search.lowest):
        raise NotConvergedError(
            "phys-geo: every rollout of the search diverged.", todo="check the masses, the units and the step_s."
        )
    record: dict[str, Any] = {
        "episodes": len(episodes),
        "search_episodes": len(searched),
        "noise_estimated": {"position_m": estimated[0], "rotation_rad": estimated[1]},
        "search_open_loop_m": search.history,
        "search_effective_samples": search.effective_samples,
    }
    if mass is not None:
        record["mass_distribution"] = mass.record
    if effects is not None:
        record["effects"] = effects.record
    best, covariance = search.mean, episode_covariance(search, search.mean, ENOUGH_EPISODES)
    if covariance is None:
        best, covariance = search.mean, search.covariance
        if search.lowest < WORTH_REFINING * _noise_floor(world, observations, sigma):
            best, covariance = _refined(world, observations, warm, names, search, sigma, config, record)
    record["correlation"] = _correlation(covariance).tolist()
    found = physics_fit(world, names, best, covariance, sigma, record)
    more = [parameter for part in (effects, mass) if part is not None for parameter in part.parameters]
    known = [*effect_parameters(world), *(p for i in world.free for p in mass_distribution(world.bodies[i].name, 1.0))]
    return replace(
        found,
        parameters=(*found.parameters, *more),
        warnings=(*found.warnings, *bound_warnings(known, more)),
        mass=mass,
        effects=effects,
    )


def _fit_effects(
    world: World,
    episodes: Sequence[tuple[str, dict[str, Track]]],
    contact: Sequence[Parameter],
    sigma: tuple[float, float],
) -> FirstContacts:
    """Fit the world's effects to flight and first contacts; the contact's numbers beside them.

    The open-loop search is for few numbers: with every effect its valley gets narrower; windows show effects well.
    """
    start = {f"{a.effect.name}.{name}": float(value) for a in world.effects for name, value in a.values.items()}
    wanted = [(parameter, start[parameter.name]) for parameter in effect_parameters(world)]
    touching = any(active.effect.phase == "contact" for active in world.effects)
    along = [(p, p.prior[0]) for p in contact]
    return fit_first_contacts(world, episodes, wanted, along, sigma, True, CONTACT_S if touching else AFTER_S)


def _noise_floor(world: World, observations: Observations, sigma: tuple[float, float]) -> float:
    """Return the displacement of a point on the surface [m] that the noise of the tracks alone looks like."""
    size = float(torch.stack([_surface_radius(world, index) for index in observations.free]).mean())
    return math.sqrt(3 * sigma[0] ** 2 + 3 * (size * sigma[1]) ** 2)


def _refined(
    world: World,
    observations: Observations,
    warm: Tensor,
    names: list[Parameter],
    search: SearchResult,
    sigma: tuple[float, float],
    config: PhysConfig,
    record: dict[str, Any],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the refined estimate and its covariance; the search's where the motion is not explained after all."""
    solution, misfit = _refine(world, observations, names, search.mean, sigma, config)
    cost = float(_open_loop(world, observations, warm, names)(solution.shared.numpy()[None]).mean())
    keep = _within(misfit, sigma, EXPLAINED) and math.isfinite(cost) and cost <= OPEN_LOOP_TOLERANCE * search.lowest
    record |= {
        "refinement_cost": solution.costs,
        "refinement_converged": solution.converged,
        "model_misfit": {"position_m": misfit[0], "rotation_rad": misfit[1]},
        "open_loop_m": {"search": search.lowest, "refined": cost},
        "kept": "refined" if keep else "search",
    }
    return (solution.shared.numpy(), _model_covariance(solution)) if keep else (search.mean, search.covariance)


def _span(tracks: dict[str, Track]) -> tuple[float, float]:
    start = min(float(track.time_s[0]) for track in tracks.values())
    end = max(float(track.time_s[-1]) for track in tracks.values())
    return start - 1e-9, min(end, start + MAX_SPAN_S) + 1e-9


def _search(
    world: World,
    observations: Observations,
    warm: Tensor,
    names: list[Parameter],
    floor: float,
    config: PhysConfig,
) -> SearchResult:
    episodes = len(observations.names)
    prior = Prior(
        np.array([p.encode(p.prior[0]) for p in names]),
        np.array([p.prior[1] for p in names]),
        np.array([p.limits for p in names]),
    )
    bar = progress(range(config.generations), "phys-geo: search", total=config.generations)
    steps = iter(bar)

    def advance(_: int, cost: float) -> None:
        next(steps, None)
        bar.set_postfix_str(f"open loop {1e3 * cost:.1f} mm")

    result = importance_search(
        _open_loop(world, observations, warm, names),
        prior,
        seed=config.seed,
        population=config.population or min(max(MAX_ROLLOUTS // episodes, POPULATION[0]), POPULATION[1]),
        generations=config.generations,
        errors=ERRORS_PER_EPISODE * episodes,
        floor=floor,
        on_generation=advance,
    )
    bar.close()
    return result


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
        base = State(
            *(getattr(observations.state, key).repeat(repeats, 1, 1) for key in observations.state.__dataclass_fields__)
        )
        drives = {name: drive.repeat(repeats) for name, drive in observations.drives.items()}
        with torch.no_grad():
            rollout = measure(
                apply_parameters(world, names, decoded), base, observations.times_s.repeat(repeats, 1), drives
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


def _refine(
    world: World,
    observations: Observations,
    names: list[Parameter],
    start: np.ndarray,
    sigma: tuple[float, float],
    config: PhysConfig,
) -> tuple[Solution, tuple[float, float]]:
    """Refine states and parameters together; before an episode's first contact the noise is the tracks' own.

    After it the model's own misfit adds to the noise; it is estimated from the residuals at the start, robustly, so
    that a model that explains the data (a simulated capture) is fitted to the noise, and one that does not (a real
    impact) is not forced through every frame.
    """
    shared = torch.as_tensor(start)
    states = torch.zeros(len(observations.names), 12 * len(observations.free)).to(shared)
    prior = state_prior(len(observations.free))
    flight = flight_frames(world, observations)
    raw = TrajectoryResiduals(world, names, observations, 1.0, 1.0)
    bounds = torch.tensor([parameter.limits for parameter in names], dtype=shared.dtype)
    misfit = (0.0, 0.0)
    solution: Solution | None = None
    for rounds in range(2):
        residual, _ = raw(shared, states, False)
        misfit = _misfit(residual, observations, flight, sigma)
        if rounds and not _within(misfit, sigma, WITHIN_REACH * EXPLAINED):
            break
        std = [
            torch.where(flight, torch.as_tensor(s), torch.as_tensor(math.hypot(s, m)))
            .repeat_interleave(len(observations.free), 1)[..., None]
            .to(shared)
            for s, m in zip(sigma, misfit, strict=True)
        ]
        solution = minimise(
            replace(raw, position_std_m=std[0], rotation_std_rad=std[1]),
            shared,
            states,
            bounds,
            robust_scale=4.0,
            iterations=config.iterations if rounds else max(2, config.iterations // 3),
            prior_information=prior,
        )
        shared, states = solution.shared, solution.states
    assert solution is not None
    return solution, misfit


def _within(misfit: tuple[float, float], sigma: tuple[float, float], share: float) -> bool:
    """Tell whether the model's own errors are at most this share of the noise (each position [m], rotation [rad])."""
    return all(error <= share * noise for error, noise in zip(misfit, sigma, strict=True))


def _misfit(
    residual: Tensor, observations: Observations, flight: Tensor, sigma: tuple[float, float]
) -> tuple[float, float]:
    """Return the model's own error after contact (position [m], rotation [rad]) beyond the noise."""
    seen = (observations.seen.flatten(1) > 0) & ~flight.repeat_interleave(len(observations.free), 1)
    values = []
    for columns, noise in ((slice(0, 3), sigma[0]), (slice(3, 6), sigma[1])):
        rows = residual[..., columns][seen].abs()
        spread = 1.4826 * float(rows.median()) if rows.numel() else 0.0
        values.append(math.sqrt(max(spread**2 - noise**2, 0.0)))
    return values[0], values[1]


def _model_covariance(solution: Solution) -> np.ndarray:
    """Return the covariance of the parameters from the curvature, scaled by the fit's reduced chi-square if above 1."""
    information = solution.information.numpy()
    eigenvalues, vectors = np.linalg.eigh(information)
    floor = np.maximum(eigenvalues, 1e-6)
    rows = solution.chi2[solution.chi2 > 0]
    scale = max(1.0, float(rows.median()) / 5.35) if rows.numel() else 1.0  # 5.35: median of chi-square, 6 degrees
    return scale * (vectors @ np.diag(1 / floor) @ vectors.T)


def _correlation(covariance: np.ndarray) -> np.ndarray:
    std = np.sqrt(np.clip(np.diag(covariance), 1e-300, None))
    return covariance / np.outer(std, std)


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
        warnings.append(
            f"with fewer than {ENOUGH_EPISODES} episodes the intervals rest on an assumption: that the errors of the "
            f"contact model in one episode count as {ERRORS_PER_EPISODE:g} independent ones"
        )
    return PhysicsFit(
        contact,
        (*fitted, *_derived(world, names, best, covariance)),
        value.get("ground_offset_m"),
        sigma,
        record,
        tuple(warnings),
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
