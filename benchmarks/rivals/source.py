"""Where a rival's code lies, and what it imports without using on the way that is taken here."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from cgwm.schemas import UsageError


def source(variable: str) -> Path:
    """Return the folder that an environment variable names, and put it first on the path of imports.

    Raises:
        UsageError: If the variable is not set, or the folder is not there.
    """
    folder = Path(os.environ.get(variable, "")).expanduser().resolve()
    if not os.environ.get(variable) or not folder.is_dir():
        found = f"{variable} is not set" if not os.environ.get(variable) else f"{folder} is no folder"
        raise UsageError(f"{found}.", "fetch the rival's repository as docs/rivals.md says, and name its folder there.")
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return folder


def module(name: str) -> Any:
    """Return a module of a rival; it has no types."""
    return importlib.import_module(name)


class _Missing(type):
    """A name of a package that is not installed: it can stand in annotations, and using it is an error."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Missing(f"{cls.__name__}.{name}", (), {})

    def __call__(cls, *arguments: Any, **named: Any) -> Any:
        raise ImportError(f"{cls.__name__} was called, and its package is not installed.")


class _Named(ModuleType):
    """A module all of whose names are `_Missing`."""

    __path__: Sequence[str] = ()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Missing(f"{self.__name__}.{name}", (), {})


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds what nobody else does, of some packages."""

    def __init__(self, packages: Sequence[str]) -> None:
        self.packages = frozenset(packages)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """Return a module of one of the packages."""
        known = fullname.split(".", maxsplit=1)[0] in self.packages
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True) if known else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Return the module."""
        return _Named(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: there is nothing in it."""


def may_lack(packages: Sequence[str]) -> None:
    """Let packages be imported that are not installed; what is installed is used, and calling what is not fails."""
    sys.meta_path.append(_Finder(packages))  # the last to be asked
