"""Runs commands in the warm server, each in a folder of its own, and returns what was seen of them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MEMORY = 6 << 30
"""Address space that a command may take beyond what the server has [bytes]."""


@dataclass(frozen=True)
class Seen:
    """What a command did."""

    code: int
    seconds: float
    timed_out: bool
    peak_mb: int
    stdout: str
    stderr: str
    events: tuple[tuple[str, ...], ...]
    """What Python wrote, changed, started, unpickled and ran from the inputs."""


class Runner:
    """A warm server; a context manager."""

    def __init__(self, home: Path, limit_s: float = 60.0) -> None:
        self.home, self.limit_s = home, limit_s
        for name in ("state", "cache", "log", "user"):
            (home / name).mkdir(parents=True, exist_ok=True)
        self._server: subprocess.Popen[str] | None = None

    def __enter__(self) -> Runner:
        # An empty entry would mean the working directory, whose folder cgwm/ is not the package.
        path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
        threads = {"OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1", "PYTHONPATH": path}
        self._server = subprocess.Popen(
            [sys.executable, "-m", "fuzz.server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **threads, **self._environment(self.home)},
        )
        return self

    def __exit__(self, *_: object) -> None:
        assert self._server is not None and self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait()

    def run(
        self, arguments: list[str], cwd: Path, temporary: Path, limit_s: float | None = None, interrupt: bool = False
    ) -> Seen:
        """Run `cgwm` with arguments in a directory, with a temporary directory of its own.

        A command that serves until it is interrupted is interrupted once it has said where.
        """
        log = Path(tempfile.mkdtemp(dir=self.home / "log"))
        answer = self._ask(
            {
                "arguments": arguments,
                "cwd": str(cwd),
                "inputs": str(cwd),
                "environment": self._environment(temporary),
                "limit_s": limit_s or self.limit_s,
                "memory": MEMORY,
                "interrupt": interrupt,
                "log": str(log),
            }
        )
        texts = {name: _text(log / name) for name in ("stdout", "stderr")}
        events = tuple(tuple(json.loads(line)) for line in _text(log / "events").splitlines())
        shutil.rmtree(log)
        return Seen(**answer, **texts, events=events)

    def _environment(self, temporary: Path) -> dict[str, str]:
        return {
            "HOME": str(self.home / "user"),
            "XDG_STATE_HOME": str(self.home / "state"),
            "XDG_CACHE_HOME": str(self.home / "cache"),
            "TMPDIR": str(temporary),
            "CGWM_TRUSTED_EFFECTS": "",
            "COLUMNS": "120",
        }

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._server is not None and self._server.stdin is not None and self._server.stdout is not None
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        line = self._server.stdout.readline()
        if not line:
            raise RuntimeError("the warm server has ended")
        return json.loads(line)


def _text(path: Path) -> str:
    return path.read_bytes().decode(errors="replace") if path.exists() else ""
