"""Which test runs which line: a plugin of pytest (`-p line_map`), and the run of the suite that uses it.

A line counts for each test that uses what the line computed: lines of fixtures that several tests share, and of cached
functions, count for all of them, and those of forked processes for the test that forked.
"""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
from changes import FOLDERS
from spread import spread

PACKAGES = {"cgwm_cli": "cli", "schemas": "schemas", "datasets": "datasets", "pipeline": "pipeline"}
"""Folders of the tree by the name that they have inside the package."""
TOGETHER, LONG = 5, 12_000
"""Short files of tests that one process runs: so many at most, of so many bytes together."""
Lines = set[tuple[str, int]]


class LineMap:
    """Plugin of pytest: lines of the product by test, with the seconds of each test that passes, as they end."""

    def __init__(self, root: Path, target: Path) -> None:
        self.root, self.target, self.pid = root, target, os.getpid()
        self.file = (target / f"map-{self.pid}.jsonl").open("a", buffering=1)
        self.prefixes = {str((root / folder).resolve()) + os.sep: folder for folder in PACKAGES}
        self.names: dict[str, str | None] = {}
        self.lines: Lines = set()
        self.fixtures: dict[Any, Lines] = defaultdict(set)
        self.tests: dict[str, dict[str, Any]] = {}
        self.current = ""
        self.monitoring = getattr(sys, "monitoring", None)
        if self.monitoring is not None:
            tool = self.monitoring.COVERAGE_ID
            self.monitoring.use_tool_id(tool, "mutants")
            self.monitoring.register_callback(tool, self.monitoring.events.LINE, self.saw)
            self.monitoring.set_events(tool, self.monitoring.events.LINE)
        else:
            threading.settrace(self.trace)
            sys.settrace(self.trace)
        self.end = os._exit
        os._exit = self.end_of_fork
        functools.lru_cache, functools.cache = self.replaying(functools.lru_cache), self.replaying(functools.cache)

    def own(self, filename: str) -> str | None:
        """Return the path of a product's file relative to the tree; None of all others."""
        if filename not in self.names:
            real = os.path.realpath(filename)
            found = next((f for p, f in self.prefixes.items() if real.startswith(p)), None)
            self.names[filename] = None if found is None else Path(real).relative_to(self.root.resolve()).as_posix()
        return self.names[filename]

    def saw(self, code: CodeType, line: int) -> Any:
        """Note a line, once until `restart` (Python 3.12 and later)."""
        path = self.own(code.co_filename)
        if path is not None:
            self.lines.add((path, line))
        return self.monitoring.DISABLE if self.monitoring else None

    def trace(self, frame: FrameType, event: str, _: Any) -> Any:
        """Note the lines of a function of the product (before Python 3.12)."""
        path = self.own(frame.f_code.co_filename)
        if path is None:
            return None

        def local(frame: FrameType, event: str, _: Any) -> Any:
            self.lines.add((path, frame.f_lineno))
            return local

        self.lines.add((path, frame.f_lineno))
        return local

    def restart(self) -> None:
        """Note lines again that have been noted."""
        if self.monitoring is not None:
            self.monitoring.restart_events()
        else:
            sys.settrace(self.trace)

    def apart(self, work: Callable[[], Any]) -> tuple[Any, Lines]:
        """Return what some work returns, and the lines that it runs; they are added to those of the test, too."""
        before, self.lines = self.lines, set()
        self.restart()
        try:
            found = work()
        finally:
            mine, self.lines = self.lines, before | self.lines
        return found, mine

    def replaying(self, cache: Any) -> Any:
        """Return a cache of functions which also returns lines: what is in the cache counts for each test that asks."""

        @functools.wraps(cache)
        def decorate(*options: Any, **named: Any) -> Any:
            if not (options and callable(options[0])):
                return lambda function: wrapped(function, cache(*options, **named))
            return wrapped(options[0], cache)

        def wrapped(function: Any, plain: Any) -> Any:
            code = getattr(function, "__code__", None)
            if code is None or not os.path.realpath(code.co_filename).startswith(str(self.root.resolve()) + os.sep):
                return plain(function)
            stored = plain(lambda *words, **named: self.apart(lambda: function(*words, **named)))

            @functools.wraps(function)
            def asked(*words: Any, **named: Any) -> Any:
                found, lines = stored(*words, **named)
                self.lines |= lines
                return found

            asked.cache_clear, asked.cache_info = stored.cache_clear, stored.cache_info  # pyright: ignore
            return asked

        return decorate

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, object, object]:
        """Keep the lines of a fixture that several tests share."""
        if fixturedef.scope == "function":
            return (yield)
        before, self.lines = self.lines, set()
        self.restart()
        try:
            return (yield)
        finally:
            self.fixtures[fixturedef] |= self.lines
            self.lines |= before

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Begin a test."""
        self.lines, self.current = set(), nodeid
        self.restart()

    def pytest_runtest_call(self, item: Any) -> None:
        """Add the lines of the fixtures that a test uses."""
        for name in item.fixturenames:
            for fixture in item._fixtureinfo.name2fixturedefs.get(name, ()):
                self.lines |= self.fixtures.get(fixture, set())

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Add the seconds of a phase."""
        entry = self.tests.setdefault(report.nodeid, {"seconds": 0.0, "passed": True})
        entry["seconds"] += report.duration
        entry["passed"] &= report.passed

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """Write the lines of a test that passed."""
        entry = self.tests.pop(nodeid, {"passed": False})
        if entry["passed"]:
            self.file.write(json.dumps({nodeid: entry | {"lines": by_file(self.lines.copy())}}) + "\n")

    def end_of_fork(self, code: int) -> None:
        """Write the lines of a process that a test has forked, and end it."""
        if os.getpid() != self.pid and self.current:
            text = json.dumps({self.current: {"lines": by_file(self.lines.copy())}})
            (self.target / f"map-{self.pid}-{os.getpid()}.jsonl").write_text(text + "\n")
        self.end(code)


def by_file(lines: Iterable[tuple[str, int]]) -> dict[str, list[int]]:
    """Return the numbers of the lines of each file."""
    found: dict[str, list[int]] = defaultdict(list)
    for path, line in sorted(lines):
        found[path].append(line)
    return found


def pytest_configure(config: Any) -> None:
    """Begin to map where this module is a plugin (`-p line_map`)."""
    target = os.environ.get("MUTANTS_MAP")
    if target:
        config.pluginmanager.register(LineMap(Path(config.rootpath), Path(target)))


def environment_of(tree: Path) -> dict[str, str]:
    """Return the variables with which a process imports `cgwm` from a tree; makes the links that it needs."""
    links = tree / ".links" / "cgwm"
    if not links.exists():
        links.mkdir(parents=True)
        for path in sorted((tree / "cgwm").iterdir()):
            if path.suffix in (".py", ".typed"):
                (links / path.name).symlink_to(path)
        for folder, name in PACKAGES.items():
            (links / name).symlink_to(tree / folder)
    others = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part and ".links" not in part]
    found = [str(links.parent), *others]
    return {
        "PYTHONPATH": os.pathsep.join(found),
        "PYTHONSAFEPATH": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
    }


def merged(target: Path) -> dict[str, Any]:
    """Return the tests that passed, with the lines of their own processes and of those that they forked."""
    tests: dict[str, Any] = {}
    found = [line for path in target.glob("map-*.jsonl") for line in path.read_text().splitlines(keepends=True)]
    entries = [entry for line in found if line.endswith("\n") for entry in json.loads(line).items()]
    for name, entry in sorted(entries, key=lambda pair: "passed" not in pair[1]):
        if "passed" in entry:
            tests[name] = entry
        elif name in tests:
            for path, lines in entry["lines"].items():
                tests[name]["lines"][path] = sorted({*lines, *tests[name]["lines"].get(path, [])})
    return tests


def in_order(root: Path, work: Path, chosen: Sequence[str]) -> list[str]:
    """Return the files of tests: those that mirror the folders to change first, and of both the longest first.

    How long is what an earlier map tells; without one the list of the suite's longest files, then their text.
    """
    known: dict[str, float] = defaultdict(float)
    if (work / "map.json").exists():
        for name, entry in json.loads((work / "map.json").read_text()).items():
            known[name.partition("::")[0]] += entry["seconds"]
    listed = re.search(r"^LONGEST = \((.*?)^\)", (root / "tests" / "conftest.py").read_text(), re.MULTILINE | re.DOTALL)
    longest = re.findall(r'"(\w+\.py)"', listed[1])[::-1] if listed else []
    files = [path.relative_to(root).as_posix() for path in (root / "tests").rglob("test_*.py")]

    def rank(name: str) -> tuple[bool, float, int, int]:
        near = name.startswith(tuple(mirror_of(folder) for folder in FOLDERS))
        base = Path(name).name
        place = longest.index(base) if base in longest else -1
        return near, known[name], place, (root / name).stat().st_size

    return sorted(chosen or files, key=rank, reverse=True)


def mirror_of(path: str) -> str:
    """Return the beginning of the names of the tests that mirror a folder, or the folder of a file."""
    folder = path if not path.endswith(".py") else path.rpartition("/")[0]
    return f"tests/{folder}/"


def batches(root: Path, names: Sequence[str]) -> list[list[str]]:
    """Return long files alone, and neighbours of short ones together: each process imports the product."""
    found: list[list[str]] = []
    size = LONG
    for name in names:
        own = (root / name).stat().st_size
        if size + own > LONG or len(found[-1]) == TOGETHER:
            found, size = [*found, []], 0
        found[-1].append(name)
        size += own
    return found


def make_map(root: Path, work: Path, jobs: int, limit_s: float | None, chosen: Sequence[str]) -> None:
    """Run the tests once, and keep which of them run which line; a test that has not ended in time counts for none."""
    target = work / "map"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    environment = environment_of(root) | {"MUTANTS_MAP": str(target)}
    del environment["PYTHONDONTWRITEBYTECODE"]
    words = ["-q", "-p", "line_map", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=short", "-rfEs"]
    parts = [[*words, *names] for names in batches(root, in_order(root, work, chosen))]
    left = spread(root, target, parts, environment, jobs, limit_s)
    tests = merged(target)
    (work / "map.json").write_text(json.dumps(tests))
    print(f"{len(tests)} tests that pass, {sum(t['seconds'] for t in tests.values()):.0f} s of them")
    for part in left:
        print(f"not ended in time: {' '.join(part[len(words) :])}")
