"""Results of benchmarks on disk, one JSON line each, so that an interrupted run goes on where it stopped.

A result counts for the commit at which it was measured and no other, unless told otherwise; `out/evidence/` keeps them
all. Where git is not there (a copy of the files on another machine), `CGWM_COMMIT` names the commit.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def shared_data() -> Path | None:
    """Return the folder of measured data, or None: `CGWM_SHARED_DATA`, or `shared/data` beside the repository."""
    folder = Path(os.environ.get("CGWM_SHARED_DATA", ROOT.parent / "shared" / "data"))
    return folder if folder.is_dir() else None


class Keyed:
    """A job that is known by its fields."""

    @property
    def key(self) -> str:
        """The result's key in the store."""
        return "/".join(str(value) for value in vars(self).values())


class Store:
    """The results of one benchmark.

    Args:
        name: Of the benchmark.
        path: Its file, in `out/evidence/` where left out. Files from several machines may be joined line by line.
        any_commit: Results of other commits count, too.
    """

    def __init__(self, name: str, path: Path | None = None, any_commit: bool = False) -> None:
        self._path = path or ROOT / "out" / "evidence" / f"{name}.jsonl"
        self._commit, self._any = commit_of_tree(), any_commit
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.is_file() else []
        # a line that was cut off by a kill is measured again
        self._rows = [row for row in map(_parsed, lines) if row is not None]

    def known(self, key: str) -> dict[str, Any] | None:
        """Return the latest result of `key` that counts, or None."""
        rows = [row for row in self._rows if row["key"] == key and self._counts(row["commit"])]
        return rows[-1] if rows else None

    def results(self) -> list[dict[str, Any]]:
        """Return the latest result of every key that counts."""
        return [row for key in dict.fromkeys(row["key"] for row in self._rows) if (row := self.known(key)) is not None]

    def add(self, key: str, figures: dict[str, Any]) -> dict[str, Any]:
        """Store a result that was just measured, and print it."""
        row = {"key": key, "commit": self._commit, "date": date.today().isoformat(), "machine": platform.machine()}
        row |= {"cpus": os.cpu_count(), **figures}
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        self._rows.append(row)
        print(json.dumps(row), flush=True)
        return row

    def result(self, key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the result of `key`, measured now unless it is already there; print it."""
        row = self.known(key)
        if row is None:
            return self.add(key, timed(measure))
        print(json.dumps(row), flush=True)
        return row

    def fill(
        self,
        work: Callable[..., dict[str, Any]],
        arguments: Mapping[str, tuple[Any, ...]],
        workers: int,
        seconds: float | None = None,
    ) -> None:
        """Store what `work` returns for the arguments of each key that has no result, from processes of one thread.

        Args:
            work: A function of a module, which the processes import.
            arguments: Arguments by key.
            workers: Number of processes.
            seconds: Time after which none is begun any more [s]; None for all.
        """
        os.environ["OMP_NUM_THREADS"] = "1"  # the workers start with it
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            missing = [key for key in arguments if self.known(key) is None]
            waiting = {pool.submit(_timed, work, arguments[key]): key for key in missing}
            try:
                for done in as_completed(waiting, seconds):
                    self.add(waiting[done], done.result())
            except TimeoutError:
                pool.shutdown(wait=False, cancel_futures=True)
                print(f"{sum(not one.done() or one.cancelled() for one in waiting)} are left.", file=sys.stderr)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # else what waits runs to its end before the error shows
                raise

    def _counts(self, commit: str) -> bool:
        return self._any or (commit == self._commit and not commit.endswith("+"))


def timed(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what `measure` returns, after its time of the wall's clock and of the processor [s]."""
    started, cpu = time.perf_counter(), time.process_time()
    figures = measure()
    wall_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
    return {"wall_s": round(wall_s, 1), "cpu_s": round(cpu_s, 1), **figures}


def _timed(work: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]) -> dict[str, Any]:
    return timed(lambda: work(*arguments))


def commit_of_tree() -> str:
    """Return the commit, with a + if files differ from it: such results are not taken up again."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    given = os.environ.get("CGWM_COMMIT")
    return given or git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and {"key", "commit"} <= set(row) else None
