"""The budget of processor time: what counts, and what happens beyond it."""

from types import SimpleNamespace

import pytest
from helpers import processor_time
from helpers.processor_time import BUDGET_S, REFERENCE_S, ProcessorTime

TESTPATHS = pytest.Config.ArgsSource.TESTPATHS


def run(total_s: float, reference_s: float = REFERENCE_S, **changed: object) -> tuple[ProcessorTime, SimpleNamespace]:
    """Return the plugin of a run of the whole suite, whose workers took so long, and the session at its end."""
    option = SimpleNamespace(keyword="", markexpr="not evidence", dist="loadfile")
    config = SimpleNamespace(option=option, args_source=TESTPATHS, **changed)
    found = ProcessorTime(config)
    found.references_s.clear()
    for part in (0.25, 0.75):
        sent = {"total_s": part * total_s, "references_s": [reference_s], "most": {f"slow-{part}": part}}
        found.pytest_testnodedown(SimpleNamespace(workeroutput={"processor_time": sent}))
    session = SimpleNamespace(exitstatus=pytest.ExitCode.OK)
    found.pytest_sessionfinish(session, pytest.ExitCode.OK)
    return found, session


@pytest.fixture(autouse=True)
def _nothing_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processor_time.time, "process_time", lambda: 0.0)


@pytest.mark.parametrize(("total_s", "reference_s", "fails"), [
    (0.99 * BUDGET_S, REFERENCE_S, False),
    (1.01 * BUDGET_S, REFERENCE_S, True),
    (1.90 * BUDGET_S, 2 * REFERENCE_S, False),  # a machine of half the speed
    (0.60 * BUDGET_S, 0.5 * REFERENCE_S, True),
])  # fmt: skip
def test_a_suite_beyond_its_budget_fails(total_s: float, reference_s: float, fails: bool) -> None:
    found, session = run(total_s, reference_s)
    assert (session.exitstatus == pytest.ExitCode.TESTS_FAILED) == fails
    assert ("mark measurements 'evidence'" in found.verdict()) == fails
    assert [name for name, _ in found.tests.most_common()] == ["slow-0.75", "slow-0.25"]


def test_parts_of_the_suite_have_no_budget() -> None:
    _, session = run(2 * BUDGET_S, workerinput={})
    assert session.exitstatus == pytest.ExitCode.OK
    found, _ = run(2 * BUDGET_S)
    found.config.option.keyword = "fused"
    assert not found.whole()
