"""Effects of contact fitted to the impacts of a ball, between the velocities that its flights show before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from .diagnosis.candidates import base_values
from .diagnosis.glide_stage import own_numbers
from .diagnosis.impact_fits import BASE, fit_impacts
from .diagnosis.impact_stage import LEAST, ImpactBase
from .diagnosis.impacts import measured_impacts
from .diagnosis.prepared import Prepared
from .first_contacts import FirstContacts
from .physics.contact import ContactLaw
from .physics.effects import Effect
from .physics.parameters import DAMPING_RATIO
from .physics.world import World
from .shown_effects import at_nothing, shown_effects


@dataclass(frozen=True)
class EffectImpacts:
    """Impacts of a ball with their fit without the effects that are wanted."""

    base: ImpactBase

    @staticmethod
    def may_tell(effect: Effect) -> bool:
        """Whether impacts may tell an effect."""
        return effect.phase == "contact"

    @staticmethod
    def of(prepared: Prepared, bare: World) -> EffectImpacts | None:
        """Find the impacts and fit them; None where there are too few, or the body is no ball.

        Args:
            prepared: The episodes.
            bare: The world without the effects that are wanted.
        """
        impacts = measured_impacts(prepared, bare) if isinstance(bare.contact, ContactLaw) else None
        return None if impacts is None or len(impacts) < LEAST else EffectImpacts(ImpactBase.of(bare, impacts))

    def fit(self, world: World, names: Sequence[str]) -> FirstContacts:
        """Fit the effects at their constants, with the contact's numbers beside them.

        Args:
            world: With the effects, and others.
            names: Of the effects.
        """
        beside = at_nothing(world, names)
        known = own_numbers(beside)
        centre = torch.cat([self.base.centre[: len(BASE)], base_values(beside, known)])
        begun = torch.cat([torch.as_tensor(self.base.fit.values[: len(BASE)]), centre[len(BASE) :]])
        problem = replace(self.base.problem, world=beside, parameters=(*BASE, *known))
        found = fit_impacts(problem, begun, centre=centre)
        prior = torch.tensor([1 / p.prior[1] ** 2 for p in problem.parameters]).to(centre)
        rows, slopes = problem.linear(torch.as_tensor(found.values))
        impacts = self.base.problem.impacts
        excess = max(float(found.chi2.sum()) / (6 * len(impacts) - len(problem.parameters)), 1.0)
        record = {
            "impacts": len(impacts),
            "costs": [float(fit.chi2.sum()) for fit in (self.base.fit, found)],
            "chi2": excess,
        }
        shown = shown_effects(
            world,
            names,
            problem.parameters,
            torch.as_tensor(found.values),
            torch.as_tensor(found.information) - torch.diag(prior),
            prior,
            -(slopes.mT @ rows[..., None])[..., 0],
            excess,
            record,
        )
        damping = DAMPING_RATIO.decode(torch.as_tensor(found.values)[BASE.index(DAMPING_RATIO)])
        return replace(shown, along={DAMPING_RATIO.name: float(damping)})
