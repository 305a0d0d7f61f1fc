"""Kill a command (SIGKILL) at random moments, and check what is left: `python tests/kill_run.py 50 [CASE ...]`.

After each kill: no input changed, the output is absent or complete, the next run succeeds, and nothing hidden is left.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cgwm.datasets import sha256
from small_model import write_small_model
from thrown_cube import write_capture

CGWM = [sys.executable, "-m", "cgwm"]
_FAST = ("phys-geo.step_s=0.004", "phys-geo.population=8", "phys-geo.generations=2", "phys-geo.iterations=1")
_SMALL = ("synthesize.duration_s=0.2", "synthesize.width=32", "synthesize.height=24")


def settings(pairs: Sequence[str]) -> list[str]:
    """Return options for settings."""
    return [word for pair in pairs for word in ("--set", pair)]


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command that writes one output."""

    words: list[str]
    """The arguments after `cgwm`."""
    again: tuple[str, ...] = ()
    """Further arguments of the run after a kill."""
    inputs: tuple[Path, ...]
    """What it reads."""
    out: Path
    """What it writes."""
    check: tuple[str, ...] = ("validate",)
    """Verb that accepts a complete output; empty where there is none."""


def _import(folder: Path) -> Command:
    capture = write_capture(folder / "source", 6)
    words = ["import", "csv", str(capture / "tracks"), "--out", str(folder / "out")]
    return Command(words=words, inputs=(capture,), out=folder / "out")


def _fit(folder: Path) -> Command:
    capture, model = write_capture(folder / "capture", 3), write_small_model(folder / "model")
    words = ["fit", str(capture), "--from", str(model), "--split", "test", "--out", str(folder / "out")]
    return Command(words=[*words, *settings(_FAST)], again=("--resume",), inputs=(capture, model), out=folder / "out")


def _dataset(folder: Path) -> Path:
    model, path = write_small_model(folder / "model"), folder / "dataset"
    words = ["synthesize", str(model), "--out", str(path), "--rollouts", "4", "--shards", "2", "--no-preview"]
    subprocess.run([*CGWM, *words, *settings(_SMALL)], check=True, capture_output=True)
    return path


def _merge(folder: Path) -> Command:
    dataset = _dataset(folder)
    words = ["merge", str(dataset), "--out", str(folder / "out")]
    return Command(words=words, inputs=(dataset,), out=folder / "out")


def _export(folder: Path) -> Command:
    dataset = _dataset(folder)
    words = ["export", str(dataset), "--to", "bop", "--out", str(folder / "out")]
    return Command(words=words, inputs=(dataset,), out=folder / "out", check=())


COMMANDS: dict[str, Callable[[Path], Command]] = {"import": _import, "fit": _fit, "merge": _merge, "export": _export}


def run(words: Sequence[str], kill_after_s: float | None = None) -> tuple[int, str]:
    """Run cgwm in a process group of its own, killed after some seconds; return its exit code and stderr."""
    process = subprocess.Popen(
        [*CGWM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        said = process.communicate(timeout=kill_after_s)[1]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return -signal.SIGKILL, ""
    return process.returncode, said


def faults_after_kill(command: Command, moment_s: float) -> list[str]:
    """Kill a command at a moment, run it again, remove its output, and return what was wrong."""
    before, beside = [sha256(path) for path in command.inputs], set(os.listdir(command.out.parent))
    found: list[str] = []
    run(command.words, moment_s)
    if [sha256(path) for path in command.inputs] != before:
        found.append("an input has changed")
    complete = command.out.exists()
    if complete and command.check and (code := run([*command.check, str(command.out)])[0]) != 0:
        found.append(f"the output is there and not complete (validate: {code})")
    if not complete:
        code, said = run([*command.words, *command.again])
        if code != 0:
            found.append(f"the next run ends with {code}: {said.strip()}")
    left = set(os.listdir(command.out.parent)) - beside - {command.out.name}
    if left:
        found.append(f"left: {', '.join(sorted(left))}")
    if [sha256(path) for path in command.inputs] != before:
        found.append("the next run has changed an input")
    shutil.rmtree(command.out, ignore_errors=True)
    return found


def kill_often(name: str, folder: Path, moments: int, seed: int = 0) -> list[str]:
    """Kill a command of `COMMANDS` at random moments of its duration; return all faults with their moments."""
    command, draw = COMMANDS[name](folder), random.Random(seed)
    began = time.monotonic()
    code, said = run(command.words)
    whole_s = time.monotonic() - began
    shutil.rmtree(command.out, ignore_errors=True)
    found = [] if code == 0 else [f"{name} ends with {code}: {said.strip()}"]
    for number in range(moments):
        moment = draw.uniform(0.0, whole_s) if number % 3 else draw.uniform(0.8, 1.0) * whole_s
        found += [f"{name} after {moment:.2f} s: {fault}" for fault in faults_after_kill(command, moment)]
    return found


if __name__ == "__main__":
    wrong = []
    for each in sys.argv[2:] or COMMANDS:
        with tempfile.TemporaryDirectory() as scratch:
            told = kill_often(each, Path(scratch), int(sys.argv[1]))
        print(f"{each}: {len(told)} faults", *told, sep="\n  ", flush=True)
        wrong += told
    sys.exit(bool(wrong))
