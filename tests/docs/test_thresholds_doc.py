"""docs/thresholds.md says what the code says: every constant that it names exists, with the value that it states."""

import ast
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "thresholds.md").read_text(encoding="utf-8")
CODE = re.compile(r"`([^`]+)`")


def rows(first: str) -> Iterator[list[str]]:
    """Yield the cells of all tables whose first column has this title."""
    inside = False
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if not line.startswith("|"):
            inside = False
        elif cells[0] == first:
            inside = True
        elif inside and not line.startswith("| ---"):
            yield cells


STATED = [
    (cells[1].strip("`"), name, value)
    for cells in rows("threshold")
    for name, value in zip(CODE.findall(cells[0]), CODE.findall(cells[2]), strict=True)
]
"""Module, constant and value of every threshold."""


def file_of(module: str) -> Path:
    return ROOT / module if module.startswith(("datasets/", "schemas/")) else ROOT / "pipeline" / module


def constants(path: Path) -> dict[str, ast.expr]:
    """Return what a module assigns to names at its top level, without importing it."""
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            found[ast.unparse(node.target)] = node.value
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                both = (target, node.value)
                pairs = zip(*(one.elts for one in both), strict=True) if isinstance(target, ast.Tuple) else [both]
                found |= {ast.unparse(name): value for name, value in pairs}
    return found


def evaluated(expression: str | ast.expr) -> object:
    """Return the value of a literal, or of arithmetic with functions of `math`."""
    node = ast.parse(expression, mode="eval").body if isinstance(expression, str) else expression
    names = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    assert names <= {"math"}, f"{ast.unparse(node)} is no literal"
    return eval(ast.unparse(node), {"__builtins__": {}, "math": math})


@pytest.mark.parametrize(("module", "name", "value"), STATED, ids=[f"{m}-{n}" for m, n, _ in STATED])
def test_the_constant_has_the_stated_value(module: str, name: str, value: str) -> None:
    path = file_of(module)
    if not path.is_file() or name not in constants(path):
        others = [
            str(other.relative_to(ROOT)) for other in (ROOT / "pipeline").rglob("*.py") if name in constants(other)
        ]
        pytest.fail(f"{path.relative_to(ROOT)} has no {name}; it is in: {', '.join(others) or 'no module'}")
    assert evaluated(constants(path)[name]) == evaluated(value)


def test_a_threshold_is_listed_once() -> None:
    places = [(module, name) for module, name, _ in STATED]
    assert len(STATED) > 200
    assert len(set(places)) == len(places)


def test_every_cell_is_filled() -> None:
    assert all(len(cells) == 6 and all(cells) for cells in rows("threshold"))


def test_decisions_name_listed_thresholds_and_their_tables() -> None:
    known = {name for _, name, _ in STATED} | {f"{Path(module).stem}.{name}" for module, name, _ in STATED}
    headings = re.findall(r"^## (.+)$", PAGE, re.M)
    anchors = {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}
    decisions = list(rows("decision"))
    assert len(decisions) > 10
    for _, thresholds, link in decisions:
        assert set(CODE.findall(thresholds)) <= known
        assert link.partition("(#")[2].rstrip(")") in anchors
    named = next(thresholds for decision, thresholds, _ in decisions if "drag" in decision)
    assert "`ALPHA`" in named
