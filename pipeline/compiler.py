"""The C++ compiler of this machine, where it has one: with it rollouts on the CPU take a tenth of the time."""

from __future__ import annotations

import os
import shutil
from functools import cache


@cache
def compiler() -> str | None:
    """Return the path of a C++ compiler; None where there is none, or it would build another kind of library."""
    if os.name != "posix":
        return None
    return next((found for name in ("g++", "clang++", "c++") if (found := shutil.which(name)) is not None), None)
