"""Do the thresholds of a diagnosis keep their false-alarm rates? Captures of development seeds, tested again.

    python benchmarks/thresholds.py --captures 200 --seeds 1 --workers 2      # all 322, 12 s of CPU time each
    python benchmarks/thresholds.py --captures 4 --seeds 0                    # four captures without an effect
    python benchmarks/thresholds.py --table                                   # of what is stored; measures nothing

Each capture is fitted as `cgwm fit` does, and every test of `cgwm diagnose` judges it, also those that an earlier test
would have ended. Stored is, for each threshold, the value of its statistic for the effect that passes all other
thresholds of its test. From the captures without an effect (nulls) follows the least value with no more false alarms
than the rate stated in `pipeline/diagnose/thresholds.py`; printed beside the value in use, with the effects that would
be named, or no longer be named, at that value. Nothing is changed. Only development seeds are used, on which thresholds
may be chosen; what is set from them has to be judged on a report that nobody has seen.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.diagnose.contact.contact_test import ContactData, ContactTest, selected
from cgwm.pipeline.diagnose.contact.search import TESTS
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.stage import library_of, prepared_world
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.diagnose.verdict import Findings, find
from cgwm.pipeline.fit import fit
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.schemas import CgwmError
from diagnose import base_settings
from hidden_effects import Case, cases, make_capture
from store import Store
from thresholds_page import groups

GROUPS = {"sliding": "sliding", "impact": "impact", "segments": "segments"}
"""Group of the thresholds of each contact test, by its name."""
STATISTICS: dict[str, Callable[[Evidence], float]] = {
    "sliding.score": lambda one: one.score,
    "sliding.explained": lambda one: one.share,
    "sliding.score_flexible": lambda one: one.score,
    "sliding.score_sure": lambda one: one.score,
    "sliding.share_sure": lambda one: one.share,
    "sliding.least_size": lambda one: one.size,
    "sliding.without_best": lambda one: one.without_best,
    "impact.score": lambda one: one.score,
    "impact.size": lambda one: one.size,
    "impact.explained": lambda one: one.share,
    "impact.gain_t": lambda one: one.gain_t,
    "segments.gain_t": lambda one: one.gain_t,
    "segments.agreed_score": lambda one: one.score,
}
"""Statistic of each threshold of a contact test that is a minimum, of the selected effect."""
LOOSE = {
    "sliding": {"score_sure": 0.0},
    "impact": {"score": -math.inf, "size": 0.0, "explained": -math.inf},
}
"""Values at which a test fits candidates that it need not look at with the thresholds in use."""


class Recorder:
    """A contact test that keeps its evidence and selects nothing, so that the tests after it run, too."""

    def __init__(self, test: Any) -> None:
        self.test, self.name, self.lists_all = test, test.name, test.lists_all
        self.found: tuple[list[Evidence], ContactData] | None = None

    def evidence(self, data: ContactData, candidates: Sequence[Candidate]) -> list[Evidence]:
        """Return and keep the evidence, of all candidates that the data can judge."""
        loose = replace(self.test.limits, **LOOSE.get(GROUPS[self.name], {}))
        evidence = replace(self.test, limits=loose).evidence(data, candidates)
        self.found = (evidence, data)
        return evidence

    def leads(self, best: Evidence) -> tuple[()]:
        """Return none."""
        return ()

    def bars(self, equals: Sequence[Evidence], data: ContactData) -> tuple[()]:
        """Return none: no effect passes."""
        return ()

    def added(self, data: ContactData, best: Evidence) -> None:
        """Return None: no effect is added."""

    def statistics(self) -> dict[str, float]:
        """Return the statistic of each threshold, by group.field, where an effect passes all others of the test."""
        if self.found is None:
            return {}
        return {name: value for name in STATISTICS if (value := self._statistic(name)) is not None}

    def _statistic(self, name: str) -> float | None:
        group, _, field = name.partition(".")
        if group != GROUPS[self.name] or self.found is None:
            return None
        open_, shut = (selected(_with(self.test, field, value), *self.found) for value in (-math.inf, math.inf))
        # what is selected whatever the threshold is, does not depend on it
        return None if shut or not open_ else STATISTICS[name](open_[0])


def _with(test: Any, field: str, value: float) -> ContactTest:
    return replace(test, limits=replace(test.limits, **{field: value}))


def measure(case: Case) -> dict[str, Any]:
    """Return the statistics of a capture."""
    with tempfile.TemporaryDirectory() as folder:
        capture, model = Path(folder) / "capture", Path(folder) / "model"
        make_capture(capture, case)
        row: dict[str, Any] = {"effects": list(case.effects), "magnitude": case.magnitude if case.effects else "null"}
        try:
            fit(capture, model, stage="phys-geo", phys_config=base_settings("tracks"))
            opened = Capture.open(capture, splits=("train",))
            world, prepared = prepared_world(read_model(model), opened, "train")
        except CgwmError as error:
            return row | {"refused": error.found}
        recorders = [Recorder(test) for test in TESTS]
        found = find(prepared, world, library_of(()), recorders)  # pyright: ignore[reportArgumentType]
        contact = {name: value for one in recorders for name, value in one.statistics().items()}
        return row | {"statistics": flight_statistics(found) | contact}


def flight_statistics(found: Findings) -> dict[str, float]:
    """Return the statistics of flight: the smallest p-value times the number of candidates, and the omnibus test."""
    p_values = [one.p_value for one in found.ranking if one.candidate.effect.phase != "contact"]
    statistics = {"flight.alpha": min(p_values) * len(p_values)} if p_values and found.flight.before is not None else {}
    if found.flight.before is not None and found.flight.before.p_value < THRESHOLDS.verdict.omnibus_p:
        statistics["verdict.omnibus_limit"] = found.flight.before.statistic
    return statistics


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """A threshold with the value that keeps its rate of false alarms."""

    name: str
    """Group and field."""
    in_use: float
    """Value in use."""
    keeps: float | None
    """Value at the edge of the stated rate; None where too few nulls have a statistic: any value keeps it."""
    alarms: int
    """Nulls that the value in use would name, all other thresholds passed."""
    nulls: int
    """Number of nulls."""
    changed: tuple[str, ...]
    """Captures with an effect whose effect is named at one of the two values only."""

    def line(self, stated: tuple[int, int]) -> str:
        """Return the row of the table."""
        keeps = "any" if self.keeps is None else f"{self.keeps:.4g}"
        changed = f"{len(self.changed)}: {', '.join(self.changed[:3])}" if self.changed else "none"
        rate = f"{stated[0]} of {stated[1]}"
        return f"| {self.name} | {self.in_use:.4g} | {rate} | {self.alarms} of {self.nulls} | {keeps} | {changed} |"


def calibrated(name: str, in_use: float, rate: float, rows: Sequence[dict[str, Any]]) -> Calibrated:
    """Return the value of a threshold that keeps a rate of false alarms on the nulls among the rows.

    Args:
        name: Group and field of the threshold.
        in_use: Its value.
        rate: Stated share of nulls with a false alarm.
        rows: Statistics of captures, as `measure` returns them.
    """
    sign = -1.0 if name == "flight.alpha" else 1.0  # a p-value is an alarm below its threshold
    nulls = [row["statistics"].get(name) for row in rows if not row["effects"]]
    seen = sorted((sign * value for value in nulls if value is not None), reverse=True)
    allowed = math.floor(rate * len(nulls) + 1e-9)
    edge = seen[allowed] if len(seen) > allowed else None
    others = {
        row["key"]: sign * row["statistics"][name] for row in rows if row["effects"] and name in row["statistics"]
    }
    between = () if edge is None else tuple(sorted((edge, sign * in_use)))
    changed = [key for key, value in others.items() if between and between[0] < value <= between[1]]
    return Calibrated(
        name=name,
        in_use=in_use,
        keeps=None if edge is None else sign * edge,
        alarms=sum(value > sign * in_use for value in seen),
        nulls=len(nulls),
        changed=tuple(changed),
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of all thresholds: those with a stated rate, then the names of the others."""
    rows = [row for row in rows if "statistics" in row]
    lines = [
        "| threshold | in use | stated rate | alarms here | keeps the rate above (p: below) | effects that change |"
    ]
    lines.append("|---|---|---|---|---|---|")
    unknown: list[str] = []
    measured = {*STATISTICS, "flight.alpha", "verdict.omnibus_limit"}
    for group, thresholds in groups().items():
        for one in thresholds:
            name = f"{group}.{one.name}"
            if one.false_alarms is None or name not in measured:
                unknown.append(name)
                continue
            alarms, nulls = one.false_alarms
            lines.append(calibrated(name, one.value, alarms / nulls, rows).line(one.false_alarms))
    return "\n".join([*lines, "", f"Without a false-alarm rate of their own, left as they are: {', '.join(unknown)}."])


def main() -> int:
    """Measure what is missing of the captures, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=200, help="captures without an effect")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each effect; 0: no captures with one")
    parser.add_argument("--only", default="", help="captures whose names contain this")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--store", type=Path, default=None, help="file of the statistics, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up statistics of other commits, too")
    parser.add_argument("--table", action="store_true", help="print the table of what is stored, and measure nothing")
    given = parser.parse_args()
    chosen = [case for case in cases("development", given.seeds, given.captures) if given.only in case.name]
    store, started = Store("thresholds", given.store, given.any_commit), time.monotonic()
    if not given.table:
        todo = {case.name: (case,) for case in chosen if store.known(case.name) is None}
        store.fill(measure, todo, given.workers)
        print(f"{len(todo)} captures in {time.monotonic() - started:.0f} s\n")
    names = {case.name for case in chosen}
    print(table([row for row in store.results() if row["key"] in names]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
