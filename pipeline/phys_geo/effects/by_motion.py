"""Fit effects to the kind of motion that identifies them: flights, sliding segments, impacts of a ball.

An effect that acts in flight is fitted to flights alone, where motion and model differ only by noise. Around an impact
the error of a contact law exceeds the influence of most effects, and a fit there would absorb that error. In sliding
and rolling the normal force is the weight under every law, so that the residual is friction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ....datasets.capture.tracks import Episode
from ...optimization.uncertainty import REACH, correlation_of, few_covariance
from ...physics.contact_law import ContactLaw
from ...physics.effects import Effect
from ...physics.parameters import DAMPING_RATIO, FRICTION, Parameter
from ...physics.world import World
from ...segments.candidates import Candidate, base_values, variants_of
from ...segments.first_contact_fit import EffectEstimate, placed
from ...segments.fitted_parameters import fitted_parameter
from ...segments.flights.shaped_errors import no_narrower
from ...segments.flights.slow_errors import slow_errors
from ...segments.impacts.fit import BASE, ImpactBase, fit_impacts
from ...segments.impacts.velocities import measured_impacts
from ...segments.prepare import Prepared, prepare
from ...segments.segment_fit import projected, refit
from ...segments.session_spread import beside_sessions
from ...segments.sliding.descent import SlidingFit, information_by_segment
from ...segments.sliding.fit import StartedSliding, contact_effect_parameters, fit_sliding, nuisance_parameters
from ...segments.sliding.variant_fits import fits_of_variants
from ...segments.thresholds import SEGMENT_THRESHOLDS
from ...trajectories.track_noise import Noise
from .identified_effects import at_neutral, identified_effects, with_constants

ITERATIONS = 25
"""Maximum number of steps in a fit to flights."""
CLOSE_SHARE, CONVERGED = 0.3, 3.0
"""Of slides, as in a diagnosis: share of the largest fall of chi2 from which on a constant's value is followed, and the
fall in a pass of steps below which a fit has converged."""
UNTOLD = REACH**2
"""Difference of chi2, in units of that of a degree of freedom, below which two fits to slides are not told apart."""


def fit_effect_flights(
    world: World,
    episodes: Sequence[Episode],
    wanted: Sequence[tuple[Parameter, float]],
    noise: Noise,
    groups: Mapping[str, str] | None = None,
) -> EffectEstimate | None:
    """Fit effects to the flights of episodes, each with its own initial state, as `cgwm diagnose` does.

    Impacts are left out, because the errors of the contact law would bias the effects' parameters. Where residuals of
    whole flights have a slow part, the fit is repeated on whole flights by generalised least squares: pieces of a
    flight with independent errors would give a slow force the wrong size, and too narrow an interval.

    Args:
        world: World with effects, none of which acts in contact alone.
        episodes: Name and tracks by body of each episode.
        wanted: Parameters of the effects, and their start.
        noise: Noise of the tracks (position [m], rotation [rad]).
        groups: Session of each episode that belongs to one.

    Returns:
        The estimate of the effects of which flights identify all parameters; None if there are none, or no flights.
    """
    prepared = prepare(world, episodes, noise)
    if prepared.flight is None:
        return None
    names = [parameter for parameter, _ in wanted]
    start = torch.tensor([parameter.encode(value) for parameter, value in wanted]).to(world.gravity)
    found = refit([prepared.flight], world, names, start, ITERATIONS)
    slow = slow_errors(prepared, found.world, ())
    if slow is not None:
        prepared = prepared.with_slow_noise(found.world, slow.noise_model)
        if prepared.flight is None:
            return None
        found = refit([prepared.flight], world, names, found.values, ITERATIONS)
    # an error of the steps is common to all frames, whose number makes the noise small beside it
    short = replace(found.segments[0], in_short_steps=True)
    found = refit([short], world, names, found.values, ITERATIONS)
    rows, jacobian = found.segments[0].residuals(names, found.values)
    linear = projected(found.segments[0], rows, jacobian, len(names))
    prior = torch.diag(torch.tensor([1 / p.prior[1] ** 2 for p in names])).to(start).numpy()
    information = linear.information.sum(0).numpy()
    # the error of an effect's formula is common to all frames of an episode
    episode = torch.tensor([item.episode for item in prepared.flight.items])
    scores = torch.stack([linear.score[episode == one].sum(0) for one in episode.unique().tolist()])
    excess = max(prepared.slow, float(linear.chi2.sum() / linear.dof.sum().clamp_min(1.0)), 1.0)
    covariance = few_covariance(information / excess + prior, scores.numpy() / excess, prior)
    values = found.values
    sessions = [(groups or {}).get(prepared.names[item.episode], "") for item in prepared.flight.items]
    beside = beside_sessions(found.segments[0], names, values, sessions, excess)
    if beside is not None:
        values, covariance = torch.from_numpy(beside.values).to(values), beside.covariance
    covariance = no_narrower(covariance, rows, jacobian, prior)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.diag(covariance))
    share = SEGMENT_THRESHOLDS.preparation.unobservable_share
    # of effects that do the same, rounding leaves no variance at all
    effect_of = [p.name.partition(".")[0] for p in names]
    unseen = {e for e, s, p in zip(effect_of, std, names, strict=True) if not s <= share * p.prior[1]}
    kept = [k for k, effect in enumerate(effect_of) if effect not in unseen]
    if not kept:
        return None
    names, values, std, covariance = [names[k] for k in kept], values[kept], std[kept], covariance[np.ix_(kept, kept)]
    parameters = tuple(fitted_parameter(p, float(z), float(s)) for p, z, s in zip(names, values, std, strict=True))
    record = {"flights": len(prepared.flight.items), "costs": [found.cost], "chi2": excess}
    if beside is not None:
        record["session_scales_std"] = beside.spread
    if slow is not None:
        record["slow_errors"] = {
            "position_std_m": slow.position_m(prepared.noise.position_m),
            "time_s": slow.noise_model.position.slow_time_s,
            "own_acceleration_std_m_s2": slow.sway_m_s2(prepared.noise.position_m),
        }
    correlation = correlation_of([p.name for p in names], covariance)
    return EffectEstimate(
        world=placed(world, names, values), parameters=parameters, record=record, correlations=(correlation,)
    )


@dataclass(frozen=True)
class SlidingStart:
    """Sliding segments of episodes, fitted without the effects that are to be fitted."""

    started: StartedSliding
    """Sliding segments with their fit."""

    @staticmethod
    def may_identify(effect: Effect) -> bool:
        """Return whether sliding can identify an effect; a force onto the ground is inseparable from friction."""
        return effect.phase == "contact" and not effect.has("wrench")

    @staticmethod
    def of(prepared: Prepared, bare: World) -> SlidingStart | None:
        """Find the sliding segments and fit them; None if there are none.

        Args:
            prepared: The episodes.
            bare: World without the effects that are to be fitted.
        """
        started = StartedSliding.of(prepared, bare, prepared.flight)
        return None if started is None else SlidingStart(started)

    def fit(self, world: World, names: Sequence[str]) -> EffectEstimate:
        """Fit the effects at their constants, together with the friction and the start of each sliding segment.

        Args:
            world: World with the effects, and possibly others.
            names: Names of the effects.
        """
        known, base = self.started.flight_parameters, self.started.base
        neutral = replace(base.segments.world, effects=at_neutral(world, names).effects)
        # friction, and height of a ground; the effects are neutral
        start = base.values[0, : 1 if neutral.ground_normal is None else 2]
        found = fit_sliding(neutral, [], [(base.segments, start)], known)[0]
        return self._estimate(world, names, neutral, found)

    def fit_one(self, world: World, name: str) -> EffectEstimate:
        """Fit one effect at all values of its constants, and return the best one.

        It is fitted as `cgwm diagnose` does: the minima of a friction that falls with the slip and of one that rises
        with it are apart, and along their valleys steps stall.

        Args:
            world: World with the effect, and possibly others.
            name: Name of the effect.
        """
        base = self.started.base
        effect = next(active.effect for active in world.effects if active.effect.name == name)
        variants = variants_of([Candidate(name, effect)], world.gravity[0, :1])
        fits = fits_of_variants(variants, self.started, 0.0, CLOSE_SHARE, CONVERGED)
        variant, found = min(fits, key=lambda one: one[1].cost)
        constants = {f"{name}.{key}": value for key, value in variant.constants.items()}
        chosen = with_constants(world, constants)
        neutral = replace(base.segments.world, effects=at_neutral(chosen, [name]).effects)
        parameters = nuisance_parameters(neutral, self.started.flight_parameters)
        bare = nuisance_parameters(base.segments.world, self.started.flight_parameters)
        order = [p.name for p in bare] + [p.name for p in parameters if p.name.partition(".")[0] == name]
        places = [order.index(p.name) for p in parameters]
        excess = max(found.cost / float(found.segments.dof.sum()), 1.0)
        alike = [fit.values[:, places] for _, fit in fits if fit.cost - found.cost < UNTOLD * excess]
        found = replace(found, values=found.values[:, places])
        apart = (torch.cat(alike) - found.values).abs().amax(0).numpy()
        estimate = self._estimate(chosen, [name], neutral, found, apart)
        record = dict(estimate.record)
        if constants:
            tried = [
                {f"{name}.{key}": value for key, value in one.constants.items()} | {"cost": fit.cost}
                for one, fit in fits
            ]
            record["constants_tried"] = tried
        return replace(estimate, constants=constants, record=record)

    def _estimate(
        self, world: World, names: Sequence[str], neutral: World, found: SlidingFit, apart: np.ndarray | None = None
    ) -> EffectEstimate:
        """Return the estimate of effects from their fit.

        Args:
            world: World with the effects.
            names: Names of the effects.
            neutral: World of the segments with the effects at neutral.
            found: The fit, of the parameters of `nuisance_parameters`.
            apart: How far each value is from those of other minima that the slides do not tell from this one.
        """
        known, base = self.started.flight_parameters, self.started.base
        parameters = nuisance_parameters(neutral, known)
        sliding = found.segments.in_world(neutral)
        information, score = information_by_segment(sliding, parameters, found.values[0])
        episodes = torch.tensor([item.episode for item in sliding.items])
        own = (episodes == episodes.unique()[:, None]).to(information)
        units, score = torch.einsum("eb,bpq->epq", own, information), own @ score
        # no prior on the friction: its start comes from the same segments, and would decide about similar effects
        prior = torch.tensor([0.0 if p is FRICTION else 1 / p.prior[1] ** 2 for p in parameters]).to(information)
        excess = max(found.cost / float(sliding.dof.sum()), 1.0)
        friction = float(found.values[0, 0].exp())
        record = {
            "glides": len(sliding.items),
            "costs": [base.cost, found.cost],
            "chi2": excess,
            "friction": friction,
        }
        estimate = identified_effects(
            world,
            names,
            parameters,
            found.values[0],
            units.sum(0),
            prior,
            units,
            score,
            excess,
            record,
            apart,
        )
        return replace(estimate, contact_start={FRICTION.name: friction})


@dataclass(frozen=True)
class ImpactStart:
    """Impacts of a ball, fitted without the effects that are to be fitted."""

    base: ImpactBase
    """Impacts with their fit."""

    @staticmethod
    def may_identify(effect: Effect) -> bool:
        """Return whether impacts can identify an effect."""
        return effect.phase == "contact"

    @staticmethod
    def of(prepared: Prepared, bare: World) -> ImpactStart | None:
        """Find the impacts and fit them; None if there are too few, or the body is not a ball.

        Args:
            prepared: The episodes.
            bare: World without the effects that are to be fitted.
        """
        impacts = measured_impacts(prepared, bare) if isinstance(bare.contact, ContactLaw) else None
        if impacts is None or len(impacts) < SEGMENT_THRESHOLDS.impact_data.least:
            return None
        return ImpactStart(ImpactBase.of(bare, impacts))

    def fit(self, world: World, names: Sequence[str]) -> EffectEstimate:
        """Fit the effects at their constants, together with the contact parameters.

        Args:
            world: World with the effects, and possibly others.
            names: Names of the effects.
        """
        neutral = at_neutral(world, names)
        parameters = contact_effect_parameters(neutral)
        centre = torch.cat([self.base.centre[: len(BASE)], base_values(neutral, parameters)])
        start = torch.cat([torch.as_tensor(self.base.fit.values[: len(BASE)]), centre[len(BASE) :]])
        problem = replace(self.base.problem, world=neutral, parameters=(*BASE, *parameters))
        found = fit_impacts(problem, start, centre=centre)
        prior = torch.tensor([1 / p.prior[1] ** 2 for p in problem.parameters]).to(centre)
        rows, slopes = (one[0] for one in problem.linear(torch.as_tensor(found.values)[None]))
        impacts = self.base.problem.impacts
        excess = max(float(found.chi2.sum()) / (6 * len(impacts) - len(problem.parameters)), 1.0)
        record = {
            "impacts": len(impacts),
            "costs": [float(fit.chi2.sum()) for fit in (self.base.fit, found)],
            "chi2": excess,
        }
        estimate = identified_effects(
            world,
            names,
            problem.parameters,
            torch.as_tensor(found.values),
            torch.as_tensor(found.information) - torch.diag(prior),
            prior,
            slopes.mT @ slopes,
            -(slopes.mT @ rows[..., None])[..., 0],
            excess,
            record,
        )
        damping = DAMPING_RATIO.decode(torch.as_tensor(found.values)[BASE.index(DAMPING_RATIO)])
        return replace(estimate, contact_start={DAMPING_RATIO.name: float(damping)})
