"""Steps of a benchmark that wait for each other, and the error budget that is made of their results."""

from __future__ import annotations

import importlib
import sys
import xml.etree.ElementTree as ET
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def module(name: str) -> ModuleType:
    """Return a module as `python benchmarks/...` has it."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def steps() -> ModuleType:
    return module("steps")


def test_steps_run_in_order_once_what_they_need_is_done(steps: ModuleType) -> None:
    done: list[str] = []

    def step(name: str, *needs):
        return steps.Step(str.upper, lambda: (name,), needs, done.append)

    first = step("a")
    second = step("b", first)
    with ThreadPoolExecutor(1) as pool:
        assert steps.run_steps(pool, [second, step("c", second), first, step("d")], 1) == 0
    assert done == ["A", "B", "C", "D"]


def test_what_needs_a_failed_step_is_left_out_and_none_begins_late(steps: ModuleType) -> None:
    failures, done = [], []
    bad = steps.Step(int, lambda: ("x",), spoils=failures.append)
    after = steps.Step(int, lambda: ("1",), (bad,), done.append)
    last = steps.Step(int, lambda: ("2",), (after,), done.append)
    with ThreadPoolExecutor(1) as pool:
        assert steps.run_steps(pool, [bad, after, last], 1) == 0
        assert not done and isinstance(failures[0], ValueError)
        late = [steps.Step(int, lambda: ("3",), (), done.append)]
        assert steps.run_steps(pool, late, 1, seconds=-1.0) == 1 and not done
        with pytest.raises(ValueError, match="invalid literal"):
            steps.run_steps(pool, [steps.Step(int, lambda: ("y",))], 1)


def result(row: str, engine: str, obj: str, mm: float, deg: float) -> dict:
    """Return a stored result of two episodes with errors about given ones."""
    episodes = [{"translation_mm": mm + k, "rotation_deg": deg} for k in (-1, 1)]
    known = {"parameter_errors": {"friction": -0.2}, "episodes": episodes}
    known |= {"true_friction": [{"translation_mm": mm / 2, "rotation_deg": deg}]} if row == "cgwm" else {}
    return {"task": "fall", "object": obj, "material": "wood", "engine": engine, "seed": 100, "row": row, **known}


@pytest.mark.evidence
def test_the_budget_pairs_captures_and_keeps_our_own_engine_apart() -> None:
    budget = module("error_budget")
    rows = [  # of the l_block cgwm alone has a result
        result("cgwm", "rapier", "box", 10, 4), result("cgwm", "rapier", "mug", 20, 6),
        result("cgwm, true shape", "rapier", "mug", 12, 3), result("cgwm, true shape", "rapier", "box", 6, 2),
        result("floor", "rapier", "box", 5, 2), result("floor", "rapier", "mug", 5, 2),
        result("cgwm", "rapier", "l_block", 50, 6),
        result("cgwm", "cgwm", "box", 3, 1),
    ]  # fmt: skip
    table = budget.table(rows)
    assert "| fall | cgwm | 2 | 15.0 | 5.0 | 20 | – | – |" in table
    assert "| fall | true friction | 2 | 7.5 | 5.0 | – | 7.5 (5.0 to 10.0) |" in table
    assert "| fall | true shape | 2 | 9.0 | 2.5 | 20 | 6.0 (4.0 to 8.0) | 2.5 (2.0 to 3.0) |" in table
    assert "our engine as the truth) | 1 | 3.0 | 1.0 | 20 | – | – |" in table
    drawn = ET.fromstring(budget.chart(rows))
    assert sum(element.tag.endswith("rect") for element in drawn) == 1 + 2 * 5
