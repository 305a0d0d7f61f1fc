"""Runs commands in the warm server, each in a folder of its own, and returns what was seen of them."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import tempfile
import traceback
import warnings
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TextIO

from fuzz import server

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

    def __enter__(self) -> Runner:
        asked, self._requests = _pipe()
        self._answers, answered = _pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads: those of xdist only wait
            self._pid = os.fork()
        if self._pid == 0:
            self._requests.close()  # else it would never see that nothing more is asked
            self._answers.close()
            self._serve(asked, answered)
        asked.close()
        answered.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._requests.close()
        os.waitpid(self._pid, 0)
        self._answers.close()

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

    def _serve(self, asked: TextIO, answered: TextIO) -> NoReturn:
        """Become the server: a fork has what the tests have loaded, and need not load it for seconds again."""
        try:
            # What the tests do at their end, such as removing their temporary folders, is not the server's to do.
            atexit._clear()
            weakref.finalize._registry.clear()  # pyright: ignore[reportAttributeAccessIssue]
            weakref.finalize._registered_with_atexit = False  # pyright: ignore[reportAttributeAccessIssue]
            # An empty entry would mean the working directory, whose folder cgwm/ is not the package.
            path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
            os.environ.update(OMP_NUM_THREADS="1", PYTHONSAFEPATH="1", PYTHONPATH=path, **self._environment(self.home))
            server.serve(asked, answered)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)

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
        self._requests.write(json.dumps(request) + "\n")
        self._requests.flush()
        line = self._answers.readline()
        if not line:
            raise RuntimeError("the warm server has ended")
        return json.loads(line)


def _pipe() -> tuple[TextIO, TextIO]:
    """Return the end of a new pipe that is read, and the one that is written."""
    read, written = os.pipe()
    return os.fdopen(read), os.fdopen(written, "w")


def _text(path: Path) -> str:
    return path.read_bytes().decode(errors="replace") if path.exists() else ""
