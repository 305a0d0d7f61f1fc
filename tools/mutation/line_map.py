"""Which test runs which line: a plugin of pytest (`-p line_map`), and the run of the suite that uses it."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

PACKAGES = {"cgwm_cli": "cli", "schemas": "schemas", "datasets": "datasets", "pipeline": "pipeline"}
"""Folders of the tree by the name that they have inside the package."""


class LineMap:
    """Plugin of pytest: lines of the product by test, with the seconds of each test that passes, as they end."""

    def __init__(self, root: Path, target: Path) -> None:
        self.root = root
        self.file = (target / f"map-{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.jsonl").open("w", buffering=1)
        self.prefixes = {str((root / folder).resolve()) + os.sep: folder for folder in PACKAGES}
        self.names: dict[str, str | None] = {}
        self.lines: set[tuple[str, int]] = set()
        self.tests: dict[str, dict[str, Any]] = {}
        self.monitoring = getattr(sys, "monitoring", None)
        if self.monitoring is not None:
            tool = self.monitoring.COVERAGE_ID
            self.monitoring.use_tool_id(tool, "mutants")
            self.monitoring.register_callback(tool, self.monitoring.events.LINE, self.saw)
            self.monitoring.set_events(tool, self.monitoring.events.LINE)
        else:
            threading.settrace(self.trace)
            sys.settrace(self.trace)

    def own(self, filename: str) -> str | None:
        """Return the path of a product's file relative to the tree; None of all others."""
        if filename not in self.names:
            real = os.path.realpath(filename)
            found = next((f for p, f in self.prefixes.items() if real.startswith(p)), None)
            self.names[filename] = None if found is None else Path(real).relative_to(self.root.resolve()).as_posix()
        return self.names[filename]

    def saw(self, code: CodeType, line: int) -> Any:
        """Note a line, once for each test (Python 3.12 and later)."""
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

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Begin a test."""
        self.lines = set()
        if self.monitoring is not None:
            self.monitoring.restart_events()
        else:
            sys.settrace(self.trace)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Add the seconds of a phase."""
        entry = self.tests.setdefault(report.nodeid, {"seconds": 0.0, "passed": True})
        entry["seconds"] += report.duration
        entry["passed"] &= report.passed

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """Write the lines of a test that passed."""
        by_file: dict[str, list[int]] = defaultdict(list)
        for path, line in self.lines.copy():  # threads that a test left behind add to it meanwhile
            by_file[path].append(line)
        entry = self.tests.pop(nodeid, {"passed": False})
        if entry["passed"]:
            entry["lines"] = {path: sorted(lines) for path, lines in by_file.items()}
            self.file.write(json.dumps({nodeid: entry}) + "\n")


def pytest_configure(config: Any) -> None:
    """Begin to map where this module is a plugin (`-p line_map`); workers map, their controller does not."""
    target = os.environ.get("MUTANTS_MAP")
    if target and (os.environ.get("PYTEST_XDIST_WORKER") or not getattr(config.option, "numprocesses", None)):
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


def make_map(root: Path, work: Path, jobs: int, limit_s: float | None, words: Sequence[str]) -> None:
    """Run the tests once, and keep which of them run which line; a test that has not ended in time counts for none."""
    target = work / "map"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    environment = os.environ | environment_of(root) | {"MUTANTS_MAP": str(target)}
    environment["PYTHONPATH"] += os.pathsep + str(Path(__file__).resolve().parent)
    spread = ["-n", str(jobs), "--dist", "loadfile", "--no-loadscope-reorder"] if jobs > 1 else []
    command = [sys.executable, "-m", "pytest", "-q", "-p", "line_map", "-p", "no:cacheprovider", *spread, *words]
    with contextlib.suppress(subprocess.TimeoutExpired):
        subprocess.run(command, cwd=root, env=environment, check=False, timeout=limit_s)
    tests: dict[str, Any] = {}
    for path in target.glob("map-*.jsonl"):
        for line in path.read_text().splitlines(keepends=True):
            tests |= json.loads(line) if line.endswith("\n") else {}
    (work / "map.json").write_text(json.dumps(tests))
    print(f"{len(tests)} tests that pass, {sum(t['seconds'] for t in tests.values()):.0f} s of them")
