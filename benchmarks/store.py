"""Results of benchmarks on disk, one JSON line each, so that an interrupted run goes on where it stopped.

A result counts for the commit at which it was measured and no other; `out/evidence/` keeps them all.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def shared_data() -> Path | None:
    """Return the folder of measured data, or None: `CGWM_SHARED_DATA`, or `shared/data` beside the repository."""
    folder = Path(os.environ.get("CGWM_SHARED_DATA", ROOT.parent / "shared" / "data"))
    return folder if folder.is_dir() else None


class Store:
    """The results of one benchmark."""

    def __init__(self, name: str) -> None:
        self._path = ROOT / "out" / "evidence" / f"{name}.jsonl"
        self._commit = _commit()
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.is_file() else []
        # a line that was cut off by a kill is measured again
        self._rows = [row for row in map(_parsed, lines) if row is not None]

    def result(self, key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the result of `key` at this commit, measured now unless it is already there; print it."""
        known = [row for row in self._rows if row["key"] == key and row["commit"] == self._commit]
        if known and not self._commit.endswith("+"):
            row = known[-1]
        else:
            started, cpu = time.perf_counter(), time.process_time()
            figures = measure()
            row = {"key": key, "commit": self._commit, "date": date.today().isoformat(), "machine": platform.machine()}
            row |= {"cpus": os.cpu_count(), "wall_s": round(time.perf_counter() - started, 1)}
            row |= {"cpu_s": round(time.process_time() - cpu, 1), **figures}
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            self._rows.append(row)
        print(json.dumps(row), flush=True)
        return row


def _commit() -> str:
    """Return the commit, with a + if files differ from it: such results are not taken up again."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and {"key", "commit"} <= set(row) else None
