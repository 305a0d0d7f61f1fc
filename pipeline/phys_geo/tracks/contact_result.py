"""Results of a fit of the contact: estimates with intervals, derived quantities, and the record for `fit.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ....datasets.capture.tracks import Track
from ....datasets.shapes.ply import Splats
from ....schemas import ContactParameters, Correlation, FitChoice, FittedParameter, PairContact
from ....schemas.materials import of_pair
from ...optimization.forward_mode import batched_jacobian
from ...optimization.uncertainty import correlation_of
from ...physics.contact_law import ContactLaw, restitution
from ...physics.paper_law import PaperLaw
from ...physics.parameters import CONTACT_PARAMETERS, CONTACT_TIME, DAMPING_RATIO, GROUND_SHIFT, Parameter
from ...physics.state import State
from ...physics.world import World
from ...report.page import listed
from ...segments.first_contact_fit import EffectEstimate
from ...segments.fitted_parameters import bound_warnings, fitted_parameter
from ...trajectories.track_noise import Noise
from .bounce_damping import BounceDamping
from .open_loop_search import ENOUGH_EPISODES, ERRORS_PER_EPISODE

KEPT_NOTE = "of the model that the fit started from, as these episodes do not observe it; "
"""Beginning of the note of an estimate that was kept."""
DISTURBED = 4.0
"""Division of the information of measured forces from which on a warning states it."""
MENTIONED_GROWTH = 1.05
"""Growth of the variances of a fit to few episodes from which on their warning states it."""


@dataclass(frozen=True, kw_only=True)
class ContactEstimate:
    """Contact parameters with their covariance, in fitted coordinates."""

    parameters: Sequence[Parameter]
    """Fitted parameters (P); `GROUND_SHIFT`, if any, last."""
    values: np.ndarray
    """Estimate, shape (P,)."""
    covariance: np.ndarray
    """Covariance of the estimate, shape (P, P)."""
    spread: np.ndarray | None = None
    """Covariance of all parameters that predict the motion about equally well, shape (P, P), from a search; None where
    `covariance` is that, too."""
    starts: dict[str, tuple[float, State]] = field(default_factory=dict)
    """Time [s] and state of the first frame of each episode, by its name, where shooting found it."""
    bounces: BounceDamping | None = None
    """Damping ratio, where the bounces of a ball gave it."""
    kept: dict[str, FittedParameter] = field(default_factory=dict)
    """Estimates of an earlier fit that stand in place of parameters which these episodes do not observe, by name."""

    def without(self, names: Sequence[str]) -> ContactEstimate:
        """Return the estimate without some parameters, which were nuisances."""
        kept = [k for k, p in enumerate(self.parameters) if p.name not in names]
        return replace(
            self,
            parameters=[self.parameters[k] for k in kept],
            values=self.values[kept],
            covariance=self.covariance[np.ix_(kept, kept)],
            spread=None if self.spread is None else self.spread[np.ix_(kept, kept)],
        )

    @property
    def contact_time_s(self) -> float:
        """Contact time of the law [s]; the prior's where it is not estimated."""
        found = zip(self.parameters, self.values, strict=True)
        return next((math.exp(z) for p, z in found if p.name == CONTACT_TIME.name), CONTACT_TIME.prior[0])


def with_damping(estimate: ContactEstimate, damping: BounceDamping) -> ContactEstimate:
    """Return an estimate of other contact parameters, completed by a damping ratio that follows the contact time."""
    place = CONTACT_PARAMETERS.index(DAMPING_RATIO)
    slope = np.array([damping.by_contact_time if p.name == CONTACT_TIME.name else 0.0 for p in estimate.parameters])

    def with_variance(covariance: np.ndarray) -> np.ndarray:
        along = covariance @ slope
        wider = np.insert(np.insert(covariance, place, along, 0), place, np.insert(along, place, 0.0), 1)
        wider[place, place] = damping.variance + slope @ along
        return wider

    return replace(
        estimate,
        parameters=[*estimate.parameters[:place], DAMPING_RATIO, *estimate.parameters[place:]],
        values=np.insert(estimate.values, place, damping.value),
        covariance=with_variance(estimate.covariance),
        spread=None if estimate.spread is None else with_variance(estimate.spread),
        bounces=damping,
    )


@dataclass(frozen=True, kw_only=True)
class ShootingRecord:
    """Course and end of multiple shooting."""

    costs: list[float]
    """Cost of each continued descent, the lowest first."""
    converged: bool
    """Whether the best descent converged."""
    misfit_ties: float
    """Mean square of the tied residuals, in units of their standard deviation."""
    misfit_frames: float
    """Median chi-square of a frame, relative to its expectation."""
    information_over: float
    """Factor by which the information of the data was divided (`tempered`)."""
    search_open_loop_m: float
    """Open-loop error [m] of the search's estimate."""
    open_loop_m: float
    """Open-loop error [m] of the estimate of shooting."""
    kept: bool
    """Whether the estimate of shooting was kept, not that of the search."""

    def to_json(self) -> dict[str, Any]:
        """Return the entries for `fit.json`."""
        return {
            "shooting_costs": self.costs,
            "shooting_converged": self.converged,
            "shooting_misfit": {
                "ties": self.misfit_ties,
                "frames": self.misfit_frames,
                "information_over": self.information_over,
            },
            "open_loop_m": {"search": self.search_open_loop_m, "shooting": self.open_loop_m},
            "kept": "shooting" if self.kept else "search",
        }


@dataclass(frozen=True, kw_only=True)
class FitRecord:
    """Course of a fit of the contact, with the entries in the order of `fit.json`."""

    episodes: int
    """Number of training episodes."""
    search_episodes: int
    """Number of episodes in the search."""
    noise_estimated: Noise
    """Noise estimated from the tracks: position [m], rotation [rad]."""
    mass_distribution: dict[str, Any] | None = None
    """Record of the fit of the mass distribution, where there was one."""
    effects: dict[str, Any] | None = None
    """Record of the fit of the effects, where there was one."""
    choice: FitChoice | None = None
    """What was chosen to be fitted, where there was a choice."""
    bounces: dict[str, Any] | None = None
    """Record of the restitution of a ball's bounces, where these gave it."""
    search_open_loop_m: list[float] | None = None
    """Lowest open-loop error [m] after each generation of the search."""
    search_effective_samples: float | None = None
    """Effective number of samples of the search; None where nothing was searched."""
    shooting: ShootingRecord | None = None
    """Course of multiple shooting, where it was used."""
    forces: dict[str, Any] | None = None
    """Record of the fit to measured forces, where there are any."""
    glides: dict[str, Any] | None = None
    """Record of the fit of joints to where nothing touches them, where forces are unknown."""
    images: dict[str, Any] = field(default_factory=dict)
    """Entries of a fit to videos."""

    def unconverged(self) -> list[str]:
        """Return a warning for each part of the fit whose descent ended at its limit of steps."""
        shot = self.shooting is None or self.shooting.converged or not self.shooting.kept
        parts = {
            "the mass distribution": (_converged(self.mass_distribution), ""),
            "the effects": (_converged(self.effects), ""),
            "the measured forces": (_converged(self.forces), ""),
            "the joints to where they glide": (_converged(self.glides), ""),
            "the contact parameters (multiple shooting)": (shot, ", or pass a larger --set phys-geo.iterations"),
        }
        return [
            f"the fit of {part} did not converge within its steps: its estimates may be off by more than their "
            f"intervals. Fit more or cleaner episodes{or_else}."
            for part, (ended, or_else) in parts.items()
            if not ended
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the entries for `fit.json`, without those of steps that were not taken."""
        position_m, rotation_rad = self.noise_estimated
        record: dict[str, Any] = {
            "episodes": self.episodes,
            "search_episodes": self.search_episodes,
            "noise_estimated": {"position_m": position_m, "rotation_rad": rotation_rad},
        }
        optional = {
            "mass_distribution": self.mass_distribution,
            "effects": self.effects,
            "choice": None if self.choice is None else self.choice.model_dump(mode="json"),
            "bounces": self.bounces,
            "search_open_loop_m": self.search_open_loop_m,
            "search_effective_samples": self.search_effective_samples,
            "forces": self.forces,
            "glides": self.glides,
        }
        record |= {name: value for name, value in optional.items() if value is not None}
        return record | ({} if self.shooting is None else self.shooting.to_json()) | self.images


def _converged(record: Mapping[str, Any] | None) -> bool:
    """Return whether the fits of a record, and of those that it holds, converged as far as they say."""
    if record is None:
        return True
    inner = (_converged(value) for value in record.values() if isinstance(value, Mapping))
    return bool(record.get("converged", True)) and all(inner)


@dataclass(frozen=True, kw_only=True)
class PhysicsFit:
    """Result of the stage phys-geo."""

    contact: ContactParameters
    """Contact parameters for `model.json`."""
    pairs: dict[tuple[str, str], PairContact] = field(default_factory=dict)
    """Those of pairs of materials, by pair."""
    parameters: tuple[FittedParameter, ...]
    """Fitted and derived parameters, with intervals, for `model.json`."""
    ground_offset_m: float | None
    """Fitted height of the ground [m]; None where it was not fitted."""
    noise: Noise
    """Standard deviation of the tracks' errors: position [m], rotation [rad]."""
    record: FitRecord
    """Course of the fit, for `fit.json`."""
    warnings: tuple[str, ...]
    """Messages for the user."""
    mass: EffectEstimate | None = None
    """Mass distribution, where it was fitted."""
    effects: EffectEstimate | None = None
    """Effects, where they were fitted."""
    constants: dict[str, float] = field(default_factory=dict)
    """Chosen constants of effects, by `effect.constant`."""
    starts: dict[str, tuple[float, State]] = field(default_factory=dict)
    """Time [s] and state of the first frame of each episode, by its name, where shooting found it."""
    collision: dict[str, Splats] = field(default_factory=dict)
    """Colliding spheres by body, where the fit moved them."""
    tracks: dict[str, dict[str, Track]] = field(default_factory=dict)
    """Tracks found in videos, by episode and body."""
    correlations: tuple[Correlation, ...] = ()
    """Correlations of the contact parameters, then of those of effects and of the mass distribution."""


def _unseen_warning(unseen: Sequence[FittedParameter]) -> list[str]:
    """Return what would reveal the parameters that data do not show; empty where they show all."""
    if not unseen:
        return []
    if len(unseen) == 1:
        return [f"{unseen[0].name} is not observable in these data; {unseen[0].note}."]
    notes = "; ".join(dict.fromkeys(p.note.removesuffix(" would reveal it") for p in unseen))
    return [f"{listed([p.name for p in unseen])} are not observable in these data; to reveal them: {notes}."]


def _force_warnings(told: Mapping[str, Any]) -> list[str]:
    """Return where measured forces contradict the model, in words; empty where they do not."""
    if not told["used"]:
        return [
            f"the measured forces are not used: the model's differ from them by {100 * told['unexplained']:.0f} % of "
            "their size in the middle, whatever its parameters. Check that they are those that the driven body exerts, "
            "not those on its sensor, in N and along the world's axes, and that nothing else touches the bodies."
        ]
    found = []
    if told.get("through_law"):
        found.append(
            "the measured forces are not all that drives these jointed bodies, or their root is free: they are "
            "compared through the contact law, in which path and shape of what pushes count as exact. Estimates may "
            "be off by more than their intervals; a fixed root, and driven bodies that all carry forces and are all "
            "that touches the links, would tell losses by momentum."
        )
    if told["apart"]:
        found.append(
            f"the measured forces on short and on long intervals ask for different values of {listed(told['apart'])}, "
            "as where a hit does not follow the contact law: the estimates are those of the long intervals, and their "
            "intervals hold both. Motions that begin in contact and without a hit would tell them apart."
        )
    if not told["described"]:
        found.append(
            f"the model's forces differ from the measured ones by {told['misfit'] ** 0.5:.2g} times their noise on "
            "short intervals: the contact has another law, or the path of the driven body has noise. The estimates are "
            "those of long intervals, and may be off by more than their intervals; a fit with another --seed shows "
            "some of it. Motions that begin in contact, without a hit, follow the law better."
        )
    elif told["information_over"] > DISTURBED:
        found.append(
            "the measured forces differ from the model's by more than their noise: intervals are "
            f"{told['information_over'] ** 0.5:.2g} times as wide as the noise alone would make them."
        )
    return found


def physics_fit(world: World, estimate: ContactEstimate, noise: Noise, record: FitRecord) -> PhysicsFit:
    """Return the stage's result from an estimate of the contact parameters.

    Args:
        world: The world that was fitted.
        estimate: The contact parameters.
        noise: Of the tracks (position [m], rotation [rad]).
        record: Course of the fit.
    """
    names, covariance = list(estimate.parameters), estimate.covariance
    std = np.sqrt(np.diag(covariance))
    fitted = [_parameter(p, z, s) for p, z, s in zip(names, estimate.values, std, strict=True)]
    if estimate.bounces is not None:
        fitted = [_from_bounces(p, estimate.bounces.bounces) if p.name == DAMPING_RATIO.name else p for p in fitted]
    warnings = bound_warnings(names, fitted)
    if GROUND_SHIFT in names and world.ground_offset is not None:
        fitted[-1] = absolute_ground(fitted[-1], float(world.ground_offset[0]))
    fitted = [_kept(estimate.kept[p.name]) if p.name in estimate.kept else p for p in fitted]
    value = {p.name: p.estimate for p in fitted}
    contact = _numbers(None, world.contact, value)
    warnings += _unseen_warning([p for p in fitted if p.state == "not_observable"])
    warnings += [] if record.forces is None else _force_warnings(record.forces)
    if record.episodes < ENOUGH_EPISODES:
        warnings.append(
            f"with fewer than {ENOUGH_EPISODES} episodes the intervals assume {_interval_assumption(record.shooting)}"
        )
    return PhysicsFit(
        contact=contact,
        pairs={
            pair: PairContact(materials=pair, **_numbers(pair, law, value).model_dump())
            for pair, law in world.pair_laws.items()
        },
        parameters=(*fitted, *_derived(world, names, estimate.values, covariance)),
        ground_offset_m=value.get("ground_offset_m"),
        noise=noise,
        record=record,
        warnings=tuple(warnings),
        starts=estimate.starts,
        correlations=(correlation_of([p.name for p in fitted], covariance),),
    )


def _numbers(
    pair: tuple[str, str] | None, law: ContactLaw | PaperLaw, fitted: Mapping[str, float]
) -> ContactParameters:
    """Return the numbers of the law of a pair of materials, fitted or those that it had."""
    before = {p.name: float(getattr(law, p.name)[0]) for p in CONTACT_PARAMETERS}
    return ContactParameters(**{name: fitted.get(of_pair(name, pair), old) for name, old in before.items()})


def _interval_assumption(shooting: ShootingRecord | None) -> str:
    """Return the assumption behind the intervals of a fit to few episodes."""
    if shooting is not None and not shooting.kept:
        return "that the search, whose estimate is kept, errs by as much as it differs from multiple shooting"
    if shooting is None:
        return f"that one episode contains {ERRORS_PER_EPISODE:g} independent errors of the contact model"
    if shooting.information_over >= MENTIONED_GROWTH:
        return (
            "that the errors of the contact model widen them to "
            f"{shooting.information_over**0.5:.2g} times what the noise alone would give"
        )
    return "that the contact model is no less accurate in other episodes than in these"


def absolute_ground(shift: FittedParameter, offset_m: float) -> FittedParameter:
    """Return the parameter of the ground's height from that of its shift.

    Args:
        shift: The shift from the ground's height before the fit.
        offset_m: That height [m].
    """
    return shift.model_copy(
        update={
            "name": "ground_offset_m",
            "estimate": shift.estimate + offset_m,
            "interval_95": _moved(shift.interval_95, offset_m),
            "bounds": _moved(shift.bounds, offset_m),
        }
    )


def _moved(interval: tuple[float, float] | None, by: float) -> tuple[float, float] | None:
    """Return an interval shifted by a constant."""
    return None if interval is None else (interval[0] + by, interval[1] + by)


def _parameter(parameter: Parameter, coordinate: float, std: float) -> FittedParameter:
    """Return a fitted parameter with its interval and prior."""
    centre, width = parameter.prior
    prior = f"normal{' in its logarithm' if parameter.logarithmic else ''} about {centre:g}, std {width:g}"
    return fitted_parameter(parameter, coordinate, std).model_copy(update={"prior": prior})


def _from_bounces(found: FittedParameter, count: int) -> FittedParameter:
    """Return the damping ratio without the prior, which bounces do not need."""
    note = f"from the heights on both sides of {count} bounces"
    state = "fitted" if found.state == "not_observable" else found.state
    return found.model_copy(update={"prior": None, "note": note, "state": state})


def _kept(found: FittedParameter) -> FittedParameter:
    """Return an earlier estimate with a note that it is one."""
    note = f"{KEPT_NOTE}{found.note.removeprefix(KEPT_NOTE)}"
    return found.model_copy(update={"note": note})


def _derived(world: World, names: list[Parameter], best: np.ndarray, covariance: np.ndarray) -> list[FittedParameter]:
    """Return restitution, stiffness and damping of a single contact below the centre of mass, to first order."""
    index = {parameter.name: k for k, parameter in enumerate(names)}
    derived = []
    if isinstance(world.contact, PaperLaw):  # its restitution depends on the step and on how many spheres touch
        return derived
    for pair in (None, *world.pair_laws):
        places = [index.get(of_pair(p.name, pair)) for p in (CONTACT_TIME, DAMPING_RATIO)]
        if places[0] is not None and places[1] is not None:
            derived += _derived_of(world, pair, (places[0], places[1]), best, covariance)
    return derived


def _derived_of(
    world: World, pair: tuple[str, str] | None, places: tuple[int, int], best: np.ndarray, covariance: np.ndarray
) -> list[FittedParameter]:
    """Return the derived quantities of the law whose contact time and damping ratio are at the given places."""
    tau, zeta = places
    mass = float(world.bodies[world.tracked[0]].mass[0])
    formulas = {
        "restitution": ("1", lambda z: restitution(z[zeta].exp())),
        "stiffness_n_m": ("N/m", lambda z: mass / z[tau].exp().square()),
        "damping_n_s_m": ("N s/m", lambda z: 2 * z[zeta].exp() * mass / z[tau].exp()),
    }
    derived, z = [], torch.tensor(best, dtype=torch.float64)[None]
    values, slopes = batched_jacobian(
        lambda inputs, _: torch.stack([formula(inputs.unbind(1)) for _, formula in formulas.values()], 1), z
    )
    for (name, (unit, _)), estimate, slope in zip(formulas.items(), values[0].tolist(), slopes[0].numpy(), strict=True):
        std = math.sqrt(float(slope @ covariance @ slope))
        reach = math.exp(min(1.96 * std / estimate, 30.0))  # first order in the logarithm, as they are positive
        note = (
            "speed ratio of a head-on impact" if name == "restitution" else f"of one contact that carries {mass:g} kg"
        )
        derived.append(
            FittedParameter(
                name=of_pair(name, pair),
                unit=unit,
                estimate=estimate,
                std_error=std,
                # an impact cannot gain energy
                interval_95=(estimate / reach, min(estimate * reach, 1.0 if name == "restitution" else math.inf)),
                state="derived",
                note=note,
            )
        )
    return derived
