"""Commands in forks of the tests' own process, which has loaded what they need: a new Python loads for two seconds.

A fork is a process like any other: it has signals, limits and an end of its own. What a new Python does before the
first line of cgwm, and what loads when, are for tests that start one.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn

from helpers.commands import Ended

Work = Callable[[], object]


class Forked:
    """`cgwm` with these words, as a shell starts it, or other work; a context manager that leaves no process behind.

    Args:
        words: The words after `cgwm`.
        environment: Variables that differ from those of the tests.
        before: Called in the new process first.
        work: Done instead of the command.
    """

    def __init__(
        self,
        *words: object,
        environment: Mapping[str, str] | None = None,
        before: Work | None = None,
        work: Work | None = None,
    ) -> None:
        self.returncode: int | None = None
        with tempfile.TemporaryDirectory() as folder:  # the files live on, without names
            self._files = [(Path(folder) / name).open("w+b") for name in ("stdout", "stderr")]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads: those of xdist only wait
            self.pid = os.fork()
        if self.pid == 0:
            self._become([str(word) for word in words], environment or {}, before, work)

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self.wait()
        for file in self._files:
            file.close()

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while it runs."""
        if self.returncode is None:
            found, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if found else None
        return self.returncode

    def wait(self, limit_s: float = 240.0) -> int:
        """Return the exit code when it has ended."""
        end, pause_s = time.monotonic() + limit_s, 0.001
        while self.poll() is None:
            assert time.monotonic() < end, f"it still runs after {limit_s} s: {self.printed()}"
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, 0.02)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def printed(self) -> tuple[str, str]:
        """Return what is on stdout and stderr so far."""
        texts = [os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode() for file in self._files]
        return texts[0], texts[1]

    def ended(self, limit_s: float = 240.0) -> Ended:
        """Wait for the end, and return exit code and texts."""
        return Ended(self.wait(limit_s), *self.printed())

    def _become(
        self, words: list[str], environment: Mapping[str, str], before: Work | None, work: Work | None
    ) -> NoReturn:
        code = 1
        try:
            gc.freeze()  # collections of its own copy no pages of what was there
            atexit._clear()
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
            nothing = os.open(os.devnull, os.O_RDONLY)
            for number, source in enumerate((nothing, *(file.fileno() for file in self._files))):
                os.dup2(source, number)
            sys.stdin, sys.stdout = open(0, closefd=False), open(1, "w", closefd=False)
            sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)
            os.environ.update(environment)
            tempfile.tempdir = None
            sys.argv = ["cgwm", *words]
            (before or bool)()
            if work is None:
                from cgwm.cli import main

                main()
            work()
            code = 0
        except SystemExit as ending:
            code = ending.code if isinstance(ending.code, int) else int(ending.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            try:
                atexit._run_exitfuncs()
                sys.stdout.flush()
            except BaseException:  # Python says this, too, when it ends
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(code)


def forked(*words: object, **options: Mapping[str, str] | Work | None) -> Ended:
    """Run a command in a fork to its end."""
    with Forked(*words, **options) as process:  # pyright: ignore[reportArgumentType]
        return process.ended()
