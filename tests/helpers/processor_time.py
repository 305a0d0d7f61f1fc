"""Processor time of the tests against the budget of the suite: printed with the costliest tests; beyond it, a failure.

Processor time hardly depends on what else runs, and a reference computation tells how fast the machine is meanwhile.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest

BUDGET_S = 400.0
"""Processor time that the whole suite may take, imports of two workers included: 4.6 of five minutes of two cores, as
343 s of it took 236 s with empty caches where the reference was measured."""
REFERENCE_S = 0.012
"""What the reference computation takes beside the tests where the budget was measured, nothing else running."""
EVERY_S = 10.0
"""Processor time between two reference computations."""
SHOWN = 10
"""Number of tests that are listed."""


def spent_s() -> float:
    """Return the processor time of this process and of its ended children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def reference_s() -> float:
    """Return the processor time of a computation as tests have many: Python objects and small arrays."""
    import numpy as np

    begun = time.process_time()
    values = np.linspace(0.0, 1.0, 30)
    kept: dict[int, float] = {}
    for k in range(10_000):
        values = np.sqrt(values * values + 1e-9)
        kept[k % 97] = float(values[k % 30])
    return time.process_time() - begun


class ProcessorTime:
    """Plugin of pytest, in the workers and in the process that collects their results."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.tests: Counter[str] = Counter()
        self.total_s, self.references_s = 0.0, [reference_s()]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Add up the processor time of a test, that of the fixtures which it is the first to use included."""
        begun = spent_s()
        try:
            return (yield)
        finally:
            self.tests[item.nodeid] += spent_s() - begun
            if spent_s() > EVERY_S * len(self.references_s):
                self.references_s.append(reference_s())

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Send what a worker has seen; fail where the whole suite took more than its budget."""
        distributed = getattr(self.config.option, "dist", "no") != "no" and not hasattr(self.config, "workerinput")
        self.total_s += time.process_time() if distributed else spent_s()
        if (output := getattr(self.config, "workeroutput", None)) is not None:
            own = {"total_s": self.total_s, "references_s": self.references_s}
            output["processor_time"] = own | {"most": dict(self.tests.most_common(SHOWN))}
        elif self.whole() and exitstatus == pytest.ExitCode.OK and self.comparable_s(self.total_s) > BUDGET_S:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Take what a worker has sent."""
        found = getattr(node, "workeroutput", {}).get("processor_time")
        if found is not None:
            self.total_s += found["total_s"]
            self.references_s += found["references_s"]
            self.tests.update(found["most"])

    def comparable_s(self, seconds: float) -> float:
        """Return a processor time as the machine of the budget would have taken it."""
        return seconds * REFERENCE_S / (sum(self.references_s) / len(self.references_s))

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the costliest tests and the sum."""
        if not self.whole():
            return
        terminalreporter.section("processor time")
        for name, seconds in self.tests.most_common(SHOWN):
            terminalreporter.write_line(f"{seconds:6.1f} s {name}")
        terminalreporter.write_line(self.verdict())

    def verdict(self) -> str:
        """Return the sum against the budget, and what to do beyond it."""
        comparable = self.comparable_s(self.total_s)
        found = f"{self.total_s:.0f} s in all, {comparable:.0f} s at the speed of reference, of {BUDGET_S:.0f} s"
        if comparable <= BUDGET_S:
            return found
        return f"{found}. Next: make tests cheaper, or mark measurements 'evidence' (docs/contributing.md)"

    def whole(self) -> bool:
        """Return whether this process reports on a run of the whole suite."""
        worker, source = hasattr(self.config, "workerinput"), self.config.args_source
        chosen = self.config.option.keyword or self.config.option.markexpr != "not evidence"
        return not worker and source is pytest.Config.ArgsSource.TESTPATHS and not chosen
