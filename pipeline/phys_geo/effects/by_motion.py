"""Effects of contact fitted to glides: while a body slides, rolls or spins on the ground its weight is the force.

About an impact a law of contact misses more than most effects change, and a fit there bends them until it fits. In a
glide the normal force is the weight by every law, so that what is left between motion and model is friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from .diagnosis.glide_fits import told_by_each
from .diagnosis.glide_stage import StartedGlides, fitted_along, fitted_glides
from .diagnosis.prepared import Prepared
from .first_contacts import FirstContacts
from .physics.effects import Effect
from .physics.parameters import FRICTION
from .physics.world import World
from .shown_effects import at_nothing, shown_effects


@dataclass(frozen=True)
class EffectGlides:
    """Glides of episodes, started without the effects that are wanted."""

    started: StartedGlides

    @staticmethod
    def may_tell(effect: Effect) -> bool:
        """Whether glides may tell an effect: what presses the body on the ground acts there as more friction does."""
        return effect.phase == "contact" and not effect.has("wrench")

    @staticmethod
    def of(prepared: Prepared, bare: World) -> EffectGlides | None:
        """Find the glides and fit them; None where there are none.

        Args:
            prepared: The episodes.
            bare: The world without the effects that are wanted.
        """
        started = StartedGlides.of(prepared, bare, prepared.flight)
        return None if started is None else EffectGlides(started)

    def fit(self, world: World, names: Sequence[str]) -> FirstContacts:
        """Fit the effects at their constants, with the friction beside them and a start of each glide.

        Args:
            world: With the effects, and others.
            names: Of the effects.
        """
        told, base = self.started.told, self.started.base
        beside = replace(base.segments.world, effects=at_nothing(world, names).effects)
        parameters = fitted_along(beside, told)
        begun = base.values[0, :2]  # friction and height; the effects at nothing
        found = fitted_glides(beside, [], [(base.segments, begun)], told)[0]
        glides = found.segments.in_world(beside)
        information, score = told_by_each(glides, parameters, found.values[0])
        # none of the friction: it begins at what glides tell, and a prior there would tell what acts like it
        prior = torch.tensor([0.0 if p is FRICTION else 1 / p.prior[1] ** 2 for p in parameters]).to(information)
        excess = max(found.cost / float(glides.dof.sum()), 1.0)
        friction = float(found.values[0, 0].exp())
        record = {
            "glides": len(glides.items),
            "costs": [base.cost, found.cost],
            "chi2": excess,
            "friction": friction,
        }
        shown = shown_effects(
            world,
            names,
            parameters,
            found.values[0],
            information.sum(0),
            prior,
            score,
            excess,
            record,
        )
        return replace(shown, along={FRICTION.name: friction})
