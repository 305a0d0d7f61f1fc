"""Runs of tests on mutants: copies of the tree, processes, results and the report."""

from __future__ import annotations

import argparse
import compileall
import json
import os
import py_compile
import re
import shutil
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from changes import Mutant, applied, sample
from line_map import PACKAGES, environment_of, mirror_of
from spread import fork_pytest, kill_group, preload

TEST_START_S, PATIENCE = 120.0, 5.0
"""A run may take so long [s], and so many times what its tests took when they were mapped: kernels whose source a
mutant changes are compiled anew.
"""

FRESH = ("new", "not run by a test")
"""States of mutants that no test has run."""

MOST_TESTS = 400
"""Tests of one run: more than that do not make a survivor likelier to be noticed."""


class Slot:
    """A copy of the tree in which one mutant at a time is tested."""

    def __init__(self, root: Path, folder: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        self.folder, self.tree = folder, folder / "tree"
        skipped = shutil.ignore_patterns(".git", ".venv", "build", "out", ".links", ".*_cache")
        shutil.copytree(root, self.tree, ignore=skipped, symlinks=True)
        (self.tree / ".venv").symlink_to(Path(sys.prefix))
        if (root.parent / "shared").exists():
            (folder / "shared").symlink_to((root.parent / "shared").resolve())
        self.environment = environment_of(self.tree)
        del self.environment["PYTHONDONTWRITEBYTECODE"]  # bytecode is compared with the hash of the source
        self.pid, self.count, self.began, self.limit = 0, 0, 0.0, 0.0
        self.mutant: Mutant | None = None
        self.before = b""
        self.tests: list[str] = []

    def begin(self, mutant: Mutant | None, tests: Sequence[str], limit: float) -> None:
        """Apply a mutant, and run tests in a process of its own until the first fails."""
        if mutant is not None:
            path = self.tree / mutant.path
            self.before = path.read_bytes()
            path.write_bytes(applied(self.before, mutant))
        self.mutant, self.count, self.began, self.limit = mutant, len(tests), time.monotonic(), limit
        stop = ["-x"] if mutant is not None else []
        self.words = ["-q", *stop, "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "named_order", *tests]
        self.words += [f"--rootdir={self.tree}", f"--basetemp={self.folder / 'tmp'}", "-rfE", "--tb=no", "-W", "ignore"]
        self.words += ["-c", str(self.tree / "pyproject.toml")]
        self.pid = fork_pytest(self.tree, self.environment, self.words, self.folder / "log")

    def ended(self) -> tuple[int | None, float] | None:
        """Return exit code (None after the time limit) and seconds of a run that is over; None while it goes on."""
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        seconds = time.monotonic() - self.began
        if not pid and seconds < self.limit:
            return None
        kill_group(self.pid)
        if not pid:
            os.waitpid(self.pid, 0)
        if self.mutant is not None:
            (self.tree / self.mutant.path).write_bytes(self.before)
        self.pid = 0
        return (os.waitstatus_to_exitcode(status) if pid else None), seconds

    def failures(self) -> list[str]:
        """Return the tests that the log names as failed."""
        text = (self.folder / "log").read_text(errors="replace")
        return re.findall(r"^(?:FAILED|ERROR) (tests/.+?)(?: - .*)?$", text, re.MULTILINE)


def chosen(tests: dict[str, Any], covering: Sequence[str], done: set[str], budget: float) -> list[str]:
    """Return the quickest tests of a line that have not run yet, of at most so many seconds, and one at least."""
    found, total = [], 0.0
    for name in sorted((name for name in covering if name not in done), key=lambda name: tests[name]["seconds"]):
        total += tests[name]["seconds"] + 0.05
        if found and (total > budget or len(found) >= MOST_TESTS):
            break
        found.append(name)
    return found


def run(root: Path, work: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Test the mutants of the sample that have no result yet, and write the report."""
    tests = json.loads((work / "map.json").read_text())
    by_line: dict[tuple[str, int], list[str]] = defaultdict(list)
    for name, entry in tests.items():
        for path, lines in entry["lines"].items():
            for line in lines:
                by_line[path, line].append(name)
    mutants = sample(root, options.count, options.seed, options.folders)
    kept = work / f"results-{options.seed}.json"
    results: dict[str, dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else {}
    for folder in PACKAGES:
        mode = py_compile.PycInvalidationMode.CHECKED_HASH
        compileall.compile_dir(root / folder, quiet=2, force=True, invalidation_mode=mode)
    slots = [Slot(root, work / "slots" / str(k)) for k in range(options.jobs)]
    preload()
    bad: set[str] = set(options.without)
    while True:
        test_all(mutants, results, (tests, by_line, bad), slots, options, kept)
        mutants = reached(mutants, results)
        kept.write_text(json.dumps(results))
        wrong = control(results, tests, slots) - bad
        if not wrong:
            break
        print(f"fail without any mutant, and no longer count: {sorted(wrong)}", flush=True)
        bad |= wrong
        results = {key: value for key, value in results.items() if value.get("killer") not in wrong}
    shutil.rmtree(work / "slots", ignore_errors=True)
    return report(mutants, results, options.folders, work)


def reached(mutants: Sequence[Mutant], results: dict[str, dict[str, Any]]) -> Sequence[Mutant]:
    """Return the mutants up to the first that was not begun in time; their order is random."""
    states = [results[key_of(mutant)]["state"] for mutant in mutants]
    return mutants[: states.index("new")] if "new" in states else mutants


def key_of(mutant: Mutant) -> str:
    """Return what tells a mutant apart from all others of the same code."""
    return f"{mutant.path}:{mutant.line}:{mutant.name}:{mutant.begin}"


def test_all(
    mutants: Sequence[Mutant],
    results: dict[str, dict[str, Any]],
    known: tuple[dict[str, Any], dict[tuple[str, int], list[str]], set[str]],
    slots: Sequence[Slot],
    options: argparse.Namespace,
    kept: Path,
) -> None:
    """Fill in the results that are missing, or of which tests are left that the budget allows now.

    After `options.limit` seconds no further mutant begins.
    """
    tests, by_line, bad = known
    waiting = []
    for mutant in mutants:
        entry = results.setdefault(key_of(mutant), asdict(mutant) | {"state": "new", "seconds": 0.0, "ran": []})
        lines = (by_line.get((mutant.path, line), ()) for line in (mutant.line, mutant.statement))
        mirror = (name for name in tests if name.startswith(mirror_of(mutant.path)))
        covering = [name for name in next(filter(None, lines), mirror) if name not in bad]
        spent = sum(tests[name]["seconds"] for name in entry["ran"] if name in tests)
        names = chosen(tests, covering, set(entry["ran"]), options.budget - spent)
        if not covering:
            entry["state"] = "not run by a test"
        elif entry["state"] in FRESH or (entry["state"] == "survived" and names and spent < 0.9 * options.budget):
            waiting.append((mutant, names))
    began, total = time.monotonic(), len(waiting)
    while waiting or any(slot.pid for slot in slots):
        if options.limit is not None and time.monotonic() - began > options.limit:
            waiting.clear()
        for slot in slots:
            if slot.pid and (over := slot.ended()) is not None:
                assert slot.mutant is not None
                take(results[key_of(slot.mutant)], over, slot)
                kept.write_text(json.dumps(results))
            if not slot.pid and waiting:
                mutant, names = waiting.pop(0)
                expected = sum(tests[name]["seconds"] for name in names)
                slot.tests = names
                slot.begin(mutant, names, TEST_START_S + PATIENCE * expected)
                if len(waiting) % 20 == 0:
                    print(f"{total - len(waiting)} of {total} begun, {time.monotonic() - began:.0f} s", flush=True)
        time.sleep(0.02)


def take(entry: dict[str, Any], over: tuple[int | None, float], slot: Slot) -> None:
    """Write down how a run of tests ended."""
    code, seconds = over
    entry["ran"] += slot.tests
    entry["seconds"] = round(entry["seconds"] + seconds, 2)
    entry["state"] = {None: "timeout", 0: "survived"}.get(code, "killed")
    if entry["state"] == "killed":  # where the file of tests cannot be read at all, the first that should have run
        entry["killer"] = next((name for name in slot.failures() if name in entry["ran"]), entry["ran"][-slot.count])


def control(results: dict[str, dict[str, Any]], tests: dict[str, Any], slots: Sequence[Slot]) -> set[str]:
    """Run the tests that killed on the unchanged code; return those that fail there, too."""
    killers = sorted({entry["killer"] for entry in results.values() if entry.get("killer") in tests})
    parts = [killers[k :: len(slots)] for k in range(len(slots))]
    busy = [(slot, part) for slot, part in zip(slots, parts, strict=True) if part]
    for slot, part in busy:
        slot.begin(None, part, TEST_START_S + PATIENCE * sum(tests[name]["seconds"] for name in part))
    wrong: set[str] = set()
    for slot, _ in busy:
        while slot.ended() is None:
            time.sleep(0.05)
        wrong |= set(slot.failures())
    return wrong


def report(
    mutants: Sequence[Mutant], results: dict[str, dict[str, Any]], folders: Sequence[str], work: Path
) -> dict[str, Any]:
    """Write and print the share killed by folder, and the survivors."""
    entries = [results[key_of(mutant)] for mutant in mutants]
    by_folder: dict[str, Counter[str]] = defaultdict(Counter)
    for entry in entries:
        folder = next(f for f in folders if entry["path"].startswith(f + "/"))
        by_folder[folder][entry["state"]] += 1
        by_folder["all"][entry["state"]] += 1
    table = {
        name: dict(states) | {"share_killed": round((states["killed"] + states["timeout"]) / states.total(), 3)}
        for name, states in sorted(by_folder.items())
    }
    alive = [entry for entry in entries if entry["state"] not in ("killed", "timeout")]
    found = {"mutants": len(entries), "folders": table, "alive": alive}
    found["cpu_minutes"] = round(sum(entry["seconds"] for entry in entries) / 60, 1)
    (work / "report.json").write_text(json.dumps(found, indent=1))
    for name, line in table.items():
        print(f"{name}: {line}")
    for entry in alive:
        print(f"{entry['state']}: {entry['path']}:{entry['line']}: {entry['name']}")
    return found
