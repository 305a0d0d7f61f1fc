"""What a diagnosis proposes to add to a model, in groups: a later group is tried where no addition of one helps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...schemas import DiagnoseResult, InputDataError
from ...schemas.improve import Reason
from ..diagnose.law_export import CLASS, save_law
from ..diagnose.thresholds import THRESHOLDS
from ..physics.effects.registry import split_units


@dataclass(frozen=True)
class Proposal:
    """Effects to add, and why."""

    effects: tuple[str, ...]
    """What to pass to `fit --effects`."""
    why: Reason
    """Where the proposal comes from."""

    @property
    def names(self) -> tuple[str, ...]:
        """The effects as a model names them: without the folder of their files."""
        return tuple(effect.rpartition("/")[2] for effect in self.effects)


def proposals_of(found: DiagnoseResult, present: Sequence[str], law: Path) -> list[list[Proposal]]:
    """Return the groups of proposals.

    What the diagnosis names comes first, together and then each alone. Where it names nothing that could be added, the
    first of its ranking and the law of the residual are tried, and the better one counts.

    Args:
        found: The diagnosis of the model.
        present: Effects of the model.
        law: File to write the law of the residual to, if there is one and the model has none yet.
    """
    there = {split_units(name)[0].rpartition("/")[2] for name in present}
    named = tuple(name for name in found.selected if name not in present)
    groups = [[Proposal(named, "selected")]] if named else []
    if len(named) > 1:
        groups.append([Proposal((one,), "one_of_the_selected") for one in named])
    first = [] if named else _first_of_the_ranking(found, there)
    if not any(name.startswith("law_") for name in there) and (saved := _saved(found, law, sorted(there))):
        first.append(Proposal((saved,), "law"))
    return [*groups, *([first] if first else [])]


def _first_of_the_ranking(found: DiagnoseResult, there: set[str]) -> list[Proposal]:
    """Return the first of the ranking that a model lacks, where nothing explains the data and chance does neither."""
    first = next((e for e in found.ranking if split_units(e.effect)[0] not in there), None)
    if found.verdict != "unexplained" or first is None or first.score_p >= THRESHOLDS.flight.alpha:
        return []
    return [Proposal((first.effect,), "first_of_the_ranking")]


def _saved(found: DiagnoseResult, law: Path, present: Sequence[str]) -> str:
    """Write the law of the residual as a custom effect, and return its name; empty where there is none to write."""
    if found.residual_law is None or not found.residual_law.terms:
        return ""
    if not law.is_file():
        try:
            save_law(found, law, present=present)
        except InputDataError:  # its terms belong to effects that are proposed or there
            return ""
    return f"{law}:{CLASS}"
