"""Impact test of a body that falls flat on a face: is its restitution one that falls with the speed?

The energies before and after such an impact follow from the flights (`segments/impacts/flat.py`), so that no contact
law enters. Only a rebound that falls with the speed is judged: what takes more of slow impacts than of fast ones, as
adhesion does, is imitated by a face that comes down a little askew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from ...segments.candidates import Candidate
from ...segments.impacts.flat import flat_impacts
from ...segments.impacts.velocities import Impacts
from ..evidence.evidence import Evidence
from ..thresholds import THRESHOLDS, ImpactThresholds
from .contact_test import Bar, ContactData
from .impact import ImpactTest


@dataclass(frozen=True)
class FlatImpactTest(ImpactTest):
    """Comparison of candidates by their residuals in flat impacts."""

    name: ClassVar[str] = "flat impact"
    lists_all: ClassVar[bool] = False

    limits: ImpactThresholds = THRESHOLDS.flat_impact
    """What decides."""

    def impacts(self, data: ContactData) -> Impacts | None:
        """Return the flat impacts; None without any."""
        return flat_impacts(data.prepared, data.world)

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[Bar, ...]:
        """Return the bar of a ball's impacts, which several held-out episodes must carry."""
        carriers = THRESHOLDS.flat_impact.carriers
        return tuple(replace(bar, carriers=carriers) for bar in super().bars(equals, data))

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return the evidence of the candidates that flat impacts tell, the best first.

        The damping of the model's corners is not that of the whole face, and is not taken over.

        Args:
            data: Motions and model.
            candidates: Candidates that the world admits.
        """
        told = [one for one in candidates if one.effect.name in THRESHOLDS.flat_impact.told]
        return [replace(one, contact={}) for one in super().evidence(data, told)] if told else []
