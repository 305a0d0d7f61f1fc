"""Damaged, absurd and malicious inputs of every kind: one message, nothing lost, nothing run; nothing good refused.

A selection with fixed seeds; `make evidence` runs all of both tables and thousands of cases. By hand, from tests/:
`python -m fuzz --cases 1000 --seed 1`, `python -m fuzz --table refuse --only plan`.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fuzz.__main__ import survey
from fuzz.cases import Trial
from fuzz.client import Runner
from fuzz.edits import Row
from fuzz.subjects import Library
from fuzz.tables import judged, must_accept, must_refuse

QUICK = ("tracks", "model", "cameras.json", "csv", "hdf5", "tum", "jugglebot", "dataset without images")
SLOW = {"fit", "diagnose", "improve", "view", "synthesize", "compare", "calibrate", "bop", "rosbag"}
LONG = {"control"}
"""Words of commands that compute for seconds where nothing is wrong; the tests of control have whole runs."""
HEAVY = ("merged dataset", "filmed", "video file", "things")
"""Subjects that take seconds to make; `test_outputs.py` has the table of what `--overwrite` may replace."""
VERBS = ("validate", "import", "merge")
CASES, SEED, LIMIT_S = 6, 3, 20.0


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trial]:
    root = tmp_path_factory.mktemp("fuzz")
    with Runner(root / "home", LIMIT_S) as runner:
        yield Trial(root / "cases", runner, Library(root / "library"))


def every(rows: list[Row], count: int, slow: set[str] = SLOW) -> list[Row]:
    """Return about `count` lines of a table of each kind, evenly spread, none whose command computes for long."""
    quick = [row for row in rows if not slow & {*row.words} and row.subject not in HEAVY]
    kinds = list(dict.fromkeys(row.kind for row in quick))
    groups = [[row for row in quick if row.kind == kind] for kind in kinds]
    return [row for group in groups for row in group[:: max(1, len(group) // count)]]


def test_whatever_the_input_there_is_one_message_and_nothing_is_lost(trial: Trial) -> None:
    bad = [
        f"{verdict.case}\n  {verdict.faults}" for verdict in survey(trial, CASES, SEED, QUICK, VERBS) if verdict.faults
    ]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("row", every(must_refuse(), 1), ids=lambda row: row.name)
def test_what_cannot_be_is_refused(trial: Trial, row: Row) -> None:
    assert not judged(trial, row, refuse=True)[1]


@pytest.mark.parametrize("row", every(must_accept(), 1, SLOW | LONG), ids=lambda row: row.name)
def test_what_is_legitimate_is_accepted(trial: Trial, row: Row) -> None:
    assert not judged(trial, row, refuse=False)[1]
