"""The C++ compiler of this machine, where it has one: with it rollouts on the CPU take a tenth of the time."""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import cache
from pathlib import Path


@cache
def compiler() -> str | None:
    """Return the path of a C++ compiler; None where there is none, or it would build another kind of library."""
    if os.name != "posix":
        return None
    return next((found for name in ("g++", "clang++", "c++") if (found := shutil.which(name)) is not None), None)


@cache
def compiler_version() -> str | None:
    """Return name and version of the compiler: another one may round otherwise. None where there is none."""
    command = compiler()
    if command is None:
        return None
    said = subprocess.run([command, "-dumpversion"], capture_output=True, text=True, check=False).stdout.strip()
    return f"{Path(command).name} {said}".strip()
