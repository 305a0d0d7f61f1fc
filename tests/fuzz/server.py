"""A process that has imported everything and forks once for each command: starting Python and torch takes seconds.

Reads one request a line, {"arguments", "cwd", "environment", "limit_s", "memory", "log"}, and answers each with
{"code", "seconds", "timed_out", "peak_mb"}. The command's streams go to files beside the log.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import pkgutil
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any, TextIO

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
STARTS = ("subprocess.Popen", "os.exec", "os.posix_spawn", "os.system", "os.spawn", "pty.spawn", "ctypes.dlopen")
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "shutil.rmtree")
LARGEST_FILE = 1 << 30


def load() -> None:
    """Import all of cgwm and what it imports when needed."""
    import cgwm.cli
    import cgwm.datasets
    import cgwm.pipeline
    import cgwm.schemas

    for package in (cgwm.schemas, cgwm.datasets, cgwm.pipeline, cgwm.cli):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)
    for name in ("viser", "av", "pyarrow.parquet", "rosbags.highlevel", "pycolmap", "mujoco", "cv2", "scipy.optimize"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def _watch(log: int, inputs: str) -> None:
    """Note what Python does to files and processes, and which code it runs from the inputs, in the file `log`."""
    inputs = os.path.realpath(inputs)

    def note(*what: object) -> None:
        os.write(log, (json.dumps(what, default=str) + "\n").encode())

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & WRITES and isinstance(path, str | bytes):
                note("write", os.path.abspath(os.fsdecode(path)))
        elif event in CHANGES:
            note("change", event, *[os.path.abspath(p) for p in arguments if isinstance(p, str)])
        elif event in STARTS:
            if event != "ctypes.dlopen" or inputs in str(arguments[0]):
                note("start", event, *map(str, arguments[:2]))
        elif event == "pickle.find_class":
            note("unpickle", *map(str, arguments))
        elif event == "exec":
            file = getattr(arguments[0], "co_filename", "")
            if not file.startswith("<") and os.path.realpath(file).startswith(inputs + os.sep):
                note("run", file)

    sys.addaudithook(hook)


def _child(request: dict[str, Any]) -> None:
    """Run one command as a user types it; never returns."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    log = Path(request["log"])
    for number, name in enumerate(("stdout", "stderr"), 1):
        opened = os.open(log / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for name in ("stdin", "stdout", "stderr"):
        number = ("stdin", "stdout", "stderr").index(name)
        setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    os.chdir(request["cwd"])
    os.environ.update(request["environment"])
    import tempfile

    tempfile.tempdir = None
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + request["memory"],) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _watch(os.open(log / "events", os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600), request["inputs"])
    code = 70
    try:
        from cgwm.cli import main

        main(request["arguments"])
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            import atexit

            atexit._run_exitfuncs()  # pyright: ignore[reportAttributeAccessIssue]
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _run(request: dict[str, Any]) -> dict[str, Any]:
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _child(request)
    timed_out, interrupted, status, usage = False, False, 0, None
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            break
        passed = time.monotonic() - began
        if passed > request["limit_s"] and not timed_out:
            timed_out = True
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
        if request["interrupt"] and not interrupted and _size(Path(request["log"]) / "stdout"):
            interrupted = True
            os.kill(child, signal.SIGINT)
        time.sleep(0.002 if passed < 0.5 else 0.02)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)  # what the command has left running
    return {
        "code": os.waitstatus_to_exitcode(status),
        "seconds": round(time.monotonic() - began, 3),
        "timed_out": timed_out,
        "peak_mb": usage.ru_maxrss // 1024,
    }


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def serve(requests: TextIO, answers: TextIO) -> None:
    """Run a command for each request until there are no more."""
    load()
    gc.collect()
    gc.freeze()  # so that a child's collections copy no pages of what is loaded
    for line in requests:
        answers.write(json.dumps(_run(json.loads(line))) + "\n")
        answers.flush()
