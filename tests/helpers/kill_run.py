"""Kill commands (SIGKILL) at random moments, and check what is left.

By hand, from tests/: `python -m helpers.kill_run 50 [CASE ...]`.

Half of the moments are random times between the start and the end of the command; the others are random operations on
files (a file opened to be written, a rename, a removal, a new folder): the process dies right before one of them.

After each kill: no input changed; the output is absent, the old one or the new one, whole; the next run succeeds and
gives what an uninterrupted run gives, to the byte but for how long it took; and nothing hidden is left.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import importlib
import json
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from helpers.kill_cases import CASES, Command, names, without_waiting

HIDDEN = re.compile(r"\..+\.(partial|pending|replaced)-.*")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate")
LIMIT_S = 120.0


def warm() -> None:
    """Import all of cgwm and what it imports when needed, so that a run costs no imports: it is a fork of this."""
    packages = [importlib.import_module(f"cgwm.{name}") for name in ("schemas", "datasets", "pipeline", "cli")]
    for package in packages:
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)
    for name in ("av", "cv2", "h5py", "hdf5plugin", "mujoco", "pycolmap", "scipy.optimize", "torch._dynamo"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


@dataclass(frozen=True)
class Ended:
    """How a run ended."""

    code: int
    said: str
    seconds: float
    operations: int
    """Operations on files."""


@dataclass
class Place:
    """A folder in which one command runs again and again."""

    folder: Path
    command: Command
    old: dict[str, str] = field(default_factory=dict)
    """Digests of the output that is there before each run, by file; empty for none."""
    new: dict[str, str] = field(default_factory=dict)
    """Digests of what an uninterrupted run writes."""

    def run(self, words: Sequence[str], after_s: float = LIMIT_S, operation: int = 0) -> Ended:
        """Run `cgwm` in a fork, in a process group of its own, killed after some seconds or before an operation."""
        log = self.folder.with_name("log")
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            self._become(words, log, operation)
        while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            left = after_s - (time.monotonic() - began)
            if left <= 0:
                break
            time.sleep(min(left, 0.005))
        seconds = time.monotonic() - began
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return Ended(code, log.read_text(errors="replace"), seconds, log.with_name("count").stat().st_size)

    def _become(self, words: Sequence[str], log: Path, operation: int) -> None:
        try:
            os.setsid()
            nowhere = os.open(os.devnull, os.O_RDWR)
            told = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            count = os.open(log.with_name("count"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number, target in enumerate((nowhere, nowhere, told)):
                os.dup2(target, number)
            os.environ["TMPDIR"] = str(self.scratch)
            os.environ["XDG_STATE_HOME"] = str(self.folder.with_name("state"))
            tempfile.tempdir = str(self.scratch)  # set: Python would try it out with a file of its own
            sys.addaudithook(_die_before(operation, count))
            from cgwm.cli import main

            main(list(words))
        except SystemExit as ended:
            os._exit(ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1)
        finally:
            os._exit(70)

    @property
    def scratch(self) -> Path:
        """The folder for temporary files."""
        return self.folder.with_name("scratch")

    def state(self) -> dict[str, str]:
        """Return the digests of the files of the output; empty for none."""
        found: dict[str, str] = {}
        for name in self.command.out:
            path = self.folder / name
            files = [entry for entry in path.rglob("*") if not entry.is_dir()] if path.is_dir() else [path]
            found |= {f.relative_to(self.folder).as_posix(): digest(f) for f in files if os.path.lexists(f)}
        return found

    def exists(self) -> bool:
        """Return whether the output has its name."""
        return os.path.lexists(self.folder / self.command.out[0])

    def inputs(self) -> dict[str, str]:
        """Return the digests of all that is neither output nor left by a killed process."""
        entries = [p.relative_to(self.folder) for p in self.folder.rglob("*") if p.is_symlink() or p.is_file()]
        mine = [p for p in entries if not self._is_output(p) and not any(map(HIDDEN.fullmatch, p.parts))]
        return {p.as_posix(): digest(self.folder / p) for p in mine}

    def left(self) -> list[str]:
        """Return what a killed process left behind."""
        hidden = [p for p in self.folder.rglob("*") if HIDDEN.fullmatch(p.name) or p.name.endswith(".checkpoint")]
        return sorted(str(p.name) for p in (*hidden, *self.scratch.iterdir()))

    def reset(self) -> None:
        """Remove the output and what was left, and put the old output there."""
        hidden = [entry for entry in self.folder.rglob(".*") if HIDDEN.fullmatch(entry.name)]
        for entry in (*hidden, *self.scratch.iterdir()):
            _remove(entry)
        for name in self.command.out:
            _remove(self.folder / name)
            _remove(self.folder / f"{name}.checkpoint")
            kept = self.folder.with_name("old") / name
            if kept.is_dir():
                shutil.copytree(kept, self.folder / name, symlinks=True)
            elif kept.exists():
                shutil.copyfile(kept, self.folder / name)

    def _is_output(self, path: Path) -> bool:
        return any(
            path.as_posix() == f"{n}" or path.as_posix().startswith((f"{n}/", f"{n}.c")) for n in self.command.out
        )


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _die_before(operation: int, count: int) -> Any:
    """Return a hook that counts operations on files as the length of a file, and kills the process before one."""
    process = os.getpid()
    done = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal done
        if event == "open":
            if not (isinstance(arguments[2], int) and arguments[2] & WRITES):
                return
        elif event not in CHANGES:
            return
        if os.getpid() == process:
            done += 1
            os.write(count, b".")
            if done == operation:
                os.killpg(process, signal.SIGKILL)

    return hook


def digest(path: Path) -> str:
    """Return what a file holds, without how long it took to make and what follows from that."""
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    if path.suffix == ".webm":
        return "a film"  # its encoder writes random numbers into it
    content = path.read_bytes()
    if path.suffix == ".json":
        with contextlib.suppress(ValueError):
            content = json.dumps(_timeless(json.loads(content)), sort_keys=True).encode()
    return hashlib.sha256(content).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, list):
        return [_timeless(part) for part in value]
    if not isinstance(value, dict):
        return value
    timed = ("fit.json", "calibration.json", "control.json")  # in a record of hashes
    times = ("seconds", "wall_time", "plan_ms", "plan_cpu_ms", "reached_hz")
    return {k: _timeless(v) for k, v in value.items() if not (k.startswith(times) or k in timed)}


@contextlib.contextmanager
def placed(name: str) -> Iterator[Place]:
    """Make the inputs of a case, the old output and the one of an uninterrupted run."""
    with tempfile.TemporaryDirectory(prefix="kill-") as folder:
        home = Path(folder) / "here"
        home.mkdir()
        (Path(folder) / "scratch").mkdir()
        place = Place(home, CASES[name](home))
        command = place.command
        for words in command.before:
            ended = place.run(words)
            assert ended.code == 0, f"{name}: {words}: {ended}"
        if command.first:
            ended = place.run(command.first)
            assert ended.code == 0, f"{name}: {ended}"
            for out in command.out:
                kept = Path(folder) / "old" / out
                kept.parent.mkdir(exist_ok=True, parents=True)
                (home / out).rename(kept)
            place.reset()
            place.old = place.state()
        yield place


@dataclass
class Outcome:
    """What was found for a case."""

    moments: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0
    operations: int = 0
    unequal: int = 0


def kill_often(name: str, kills: int, seed: int = 0) -> Outcome:
    """Kill a case at random moments of its duration."""
    draw, outcome = random.Random(seed), Outcome()
    with placed(name) as place:
        runs = []
        for _ in range(2):  # the second one is the faster, and must give the same
            place.reset()
            runs.append(place.run(place.command.words))
            if runs[-1].code != 0:
                outcome.faults.append(f"ends with {runs[-1].code}: {runs[-1].said.strip()}")
                return outcome
            if place.new and place.state() != place.new:
                outcome.faults.append(f"two runs differ: {_difference(place.new, place.state())}")
            place.new = place.state()
        outcome.seconds, outcome.operations = runs[-1].seconds, runs[-1].operations
        for verb in place.command.check:
            ended = place.run([*verb])
            if ended.code != 0:
                outcome.faults.append(f"{' '.join(verb)} ends with {ended.code}: {ended.said.strip()}")
        for number in range(kills):
            if number % 2 and outcome.operations:
                operation, after_s = draw.randint(1, outcome.operations), LIMIT_S
                moment = f"before operation {operation}"
            else:
                operation, after_s = 0, draw.uniform(0.0, outcome.seconds)
                moment = f"after {after_s:.2f} s"
            faults, when = _faults(place, after_s, operation)
            outcome.moments[when] += 1
            outcome.faults += [f"{moment} ({when} writing): {fault}" for fault in faults]
    return outcome


def _faults(place: Place, after_s: float, operation: int) -> tuple[list[str], str]:
    """Kill a command once, run it again, and return what was wrong, and whether it was writing."""
    place.reset()
    before, command, found = place.inputs(), place.command, []
    ended = place.run(command.words, after_s, operation)
    state, left = place.state(), place.left()
    changed = state != place.old
    when = "ended before" if ended.code == 0 else "after" if changed and not left else "inside" if left else "before"
    if ended.code not in (0, -signal.SIGKILL):
        found.append(f"ends with {ended.code}: {ended.said.strip()}")
    if place.inputs() != before:
        found.append(f"an input has changed: {_difference(before, place.inputs())}")
    whole = not place.exists() or state in (place.old, place.new)
    if len(command.out) > 1:  # files of a folder: at times some are lacking, but never are there some of two sets
        whole = whole or any(state.items() <= one.items() for one in (place.old, place.new))
    if not whole and not (command.grows and _grown(state, place.new)):
        found.append(f"the output is neither old nor new: {_difference(place.old or place.new, state)}; left {left}")
    if not place.exists() and place.old:
        when = "between"  # the old one has another name for an instant; the next run gives it back
    again = place.run([*command.words, *command.again])
    if again.code:  # the same command keeps what it has made, and ends with 0
        found.append(f"the next run ends with {again.code}: {again.said.strip()}")
    elif place.state() != place.new:
        found.append(f"the next run gives another output: {_difference(place.new, place.state())}")
    if place.left():
        found.append(f"the next run leaves {', '.join(place.left())}")
    if place.inputs() != before:
        found.append(f"the next run has changed an input: {_difference(before, place.inputs())}")
    return found, when


def _grown(state: dict[str, str], new: dict[str, str]) -> bool:
    """Return whether every shard that is there is the right one."""
    shards = [name for name in state if name.endswith(".h5")]
    return all(state[name] == new.get(name) for name in shards)


def _difference(one: dict[str, str], other: dict[str, str]) -> str:
    names = [
        f"{'-' if n not in other else '+' if n not in one else '!'}{n}"
        for n in sorted({*one, *other})
        if one.get(n) != other.get(n)
    ]
    return ", ".join(names)


def main(arguments: Sequence[str]) -> int:
    """Run the cases and print a line for each; return the exit code."""
    kills = int(arguments[0])
    warm()
    without_waiting()
    wrong = 0
    for name in names(arguments[1:]):
        began = time.monotonic()
        outcome = kill_often(name, kills)
        moments = ", ".join(f"{count} {when}" for when, count in sorted(outcome.moments.items()))
        print(
            f"{name}: {outcome.seconds:.1f} s, {outcome.operations} operations; {outcome.moments.total()} kills "
            f"({moments}); {len(outcome.faults)} faults; {time.monotonic() - began:.0f} s",
            *outcome.faults,
            sep="\n  ",
            flush=True,
        )
        wrong += len(outcome.faults)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
