"""Checkpoints of a fit, from which an interrupted one continues with `--resume`.

They are stored in the directory `MODEL.checkpoint` next to the model, one file per descent. Files are written
atomically, so that a fit that is killed at any moment leaves the last complete one. They hold the full state of a
descent, including its random generators: a resumed fit gives the same spheres as an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.io.atomic import replaced_file
from ...datasets.io.directory_lock import NAME as LOCK_NAME
from ...datasets.io.directory_lock import DirectoryLock
from ...schemas import InputDataError, UsageError

State = dict[str, Any]
"""State of a descent: tensors, numbers, text, and lists and dictionaries of them."""
Array = NDArray[Any]

_KEY = "made_of.json"
"""File that names what the fit is made of."""
_OWN = re.compile(LOCK_NAME + r"|[\w-]*-[0-9a-f]{8}\.npz|\..*\.partial-.*")
"""Names of the other files of a checkpoint, and of unfinished ones."""


class Checkpoint:
    """Checkpoints of one fit; none is written before the fit has run for `every_s`.

    Args:
        path: Directory, which is created with the first checkpoint.
        made_of: Settings and inputs of the fit by name, as text; a checkpoint of other ones is refused.
        every_s: Minimum time between two checkpoints [s].
    """

    def __init__(self, path: Path, made_of: Mapping[str, str], every_s: float = 15.0) -> None:
        self.path = path
        self._made_of = dict(made_of)
        self._every_s = every_s
        self._last = time.monotonic()
        self._lock = DirectoryLock(path)

    @staticmethod
    def of(out: Path, made_of: Mapping[str, str]) -> Checkpoint:
        """Return the checkpoints of the work that writes `out`, whatever is there."""
        return Checkpoint(out.with_name(f"{out.name}.checkpoint"), made_of)

    @staticmethod
    def beside(out: Path, made_of: Mapping[str, str], resume: bool, overwrite: bool, work: str = "a fit") -> Checkpoint:
        """Return the checkpoints of the work that writes `out`; existing ones are kept if it resumes.

        Raises:
            UsageError: If the directory exists and holds no checkpoints, if another process writes them, if they are
                there and neither `resume` nor `overwrite` is set, or if the fit to resume had other settings or inputs.
        """
        checkpoint = Checkpoint.of(out, made_of)
        path = checkpoint.path
        if not path.exists():
            return checkpoint
        if checkpoint._is_torn():
            shutil.rmtree(path)
            return checkpoint
        if not (path / _KEY).is_file():
            raise UsageError(
                f"{path} is in the way: checkpoints go there, and it holds none.",
                todo="move it, or choose another --out.",
            )
        if not checkpoint._lock.hold():
            raise UsageError(
                f"{path}: another process is writing {work} of {out} now.",
                todo="wait until it has ended, or choose another --out.",
            )
        if resume:
            checkpoint._refuse_others()
        elif overwrite:
            checkpoint.remove()
        else:
            raise UsageError(
                f"{path} holds {work} of {out} that was interrupted.",
                todo="pass --resume to go on with it, or --overwrite to begin again.",
            )
        return checkpoint

    @staticmethod
    def remove_of(out: Path, made_of: Mapping[str, str]) -> None:
        """Remove the checkpoints of a complete model `out`, but not those of a fit that is made of something else."""
        checkpoint = Checkpoint.of(out, made_of)
        if checkpoint._is_torn():
            shutil.rmtree(checkpoint.path)
        elif not checkpoint._differing():
            checkpoint.remove()

    def slot(self, name: str) -> Slot:
        """Return the storage of one descent's state."""
        return Slot(self, name)

    def remove(self) -> None:
        """Remove all checkpoints, when the model is complete."""
        if (self.path / _KEY).is_file():
            shutil.rmtree(self.path)
        self._lock.release()

    def due(self) -> bool:
        """Return whether the last checkpoint is at least `every_s` old."""
        return time.monotonic() - self._last >= self._every_s

    def write(self, name: str, state: State) -> None:
        """Write a state atomically.

        Raises:
            UsageError: If another process, which began at the same time, writes these checkpoints.
        """
        fresh = not (self.path / _KEY).is_file()
        if fresh:
            self._lock.release()  # of a directory that was removed
            self.path.mkdir(parents=True, exist_ok=True)
        if not self._lock.hold():
            raise UsageError(
                f"{self.path}: another process is writing there now.",
                todo="wait until it has ended, or choose another --out.",
            )
        if fresh:
            with replaced_file(self.path / _KEY) as path:
                path.write_text(json.dumps(self._made_of, indent=1) + "\n", encoding="utf-8")
        with replaced_file(self.path / _file_name(name)) as path:
            arrays: list[Array] = []
            frame = json.dumps(_taken_apart(state, arrays))
            with path.open("wb") as stream:  # an open file: savez would put another suffix after the name
                named = {"frame": np.array(frame)} | {str(k): array for k, array in enumerate(arrays)}
                np.savez(stream, allow_pickle=False, **named)
        self._last = time.monotonic()

    def read(self, name: str, device: torch.device) -> State | None:
        """Return a state with its tensors on a device; None where there is none.

        Raises:
            InputDataError: If the file cannot be read.
        """
        path = self.path / _file_name(name)
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                return _put_together(json.loads(str(stored["frame"])), stored, device)
        except (OSError, ValueError, TypeError, KeyError, EOFError, RecursionError, zipfile.BadZipFile) as error:
            raise InputDataError(
                f"{path}: the checkpoint cannot be read ({type(error).__name__}).",
                todo="remove the file, or pass --overwrite to begin the fit again.",
            ) from None

    def _is_torn(self) -> bool:
        """Return whether the directory is what a process left that was killed while it made or removed it."""
        if not self.path.is_dir() or (self.path / _KEY).exists():
            return False
        return all(_OWN.fullmatch(entry.name) for entry in self.path.iterdir())

    def stored(self) -> dict[str, Any]:
        """Return what the checkpoints that are there were made of; nothing where none can be read."""
        try:
            found = json.loads((self.path / _KEY).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            found = {}
        return found if isinstance(found, dict) else {}

    def _differing(self) -> list[str]:
        found = self.stored()
        return sorted(name for name in {*found, *self._made_of} if found.get(name) != self._made_of.get(name))

    def _refuse_others(self) -> None:
        names = self._differing()
        if names:
            raise UsageError(
                f"{self.path} was made with other {', '.join(names)}.",
                "the same command, on the same capture, with --resume.",
                "pass what was passed before, or --overwrite to begin again.",
            )


class Slot:
    """Storage of one descent's state in a checkpoint."""

    def __init__(self, checkpoint: Checkpoint, name: str) -> None:
        self._checkpoint, self._name = checkpoint, name

    @property
    def path(self) -> Path:
        """Its file."""
        return self._checkpoint.path / _file_name(self._name)

    def read(self, device: torch.device) -> State | None:
        """Return the last written state; None where there is none."""
        return self._checkpoint.read(self._name, device)

    def due(self) -> bool:
        """Return whether the next state should be written."""
        return self._checkpoint.due()

    def write(self, state: State) -> None:
        """Write the state."""
        self._checkpoint.write(self._name, state)


def _file_name(name: str) -> str:
    """Return the file name of a descent: its name in plain letters, made unique by a hash."""
    plain = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)
    return f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}.npz"


def _taken_apart(value: Any, arrays: list[Array]) -> Any:
    """Return a state for JSON, with tensors replaced by their index in `arrays`, to which they are appended."""
    if isinstance(value, Tensor):
        arrays.append(value.detach().cpu().numpy())
        return {"tensor": len(arrays) - 1}
    if isinstance(value, dict):  # as pairs, for the keys of Adam's state are numbers
        return {"dict": [[key, _taken_apart(entry, arrays)] for key, entry in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_taken_apart(entry, arrays) for entry in value]}
    return value


def _put_together(value: Any, arrays: Mapping[str, Array], device: torch.device) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "tensor":
        return torch.from_numpy(arrays[str(content)]).to(device)
    if kind == "dict":
        return {key: _put_together(entry, arrays, device) for key, entry in content}
    entries = [_put_together(entry, arrays, device) for entry in content]
    return tuple(entries) if kind == "tuple" else entries
