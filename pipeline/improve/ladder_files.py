"""Files of an unfinished ladder, in the directory `DIR.checkpoint` beside the output; an interrupted one continues.

Each file and each model gets its name when it is complete, and is read back from disk, so that a ladder that continues
works on the same numbers as one that was never interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from ...datasets.io.atomic import remove_directory, replaced_file
from ...datasets.io.directory_lock import NAME as LOCK_NAME
from ...datasets.io.directory_lock import DirectoryLock
from ...schemas import FileModel, UsageError, read_json

DocumentT = TypeVar("DocumentT", bound=FileModel)

_KEY = "made_of.json"


def _is_ours(name: str) -> bool:
    """Return whether a file is what a ladder leaves that was killed before it had a key."""
    return name == LOCK_NAME or name.startswith(f".{_KEY}.")


class LadderFiles:
    """Directory of an unfinished ladder.

    Args:
        out: The directory that the ladder gets when it is complete.
        made_of: Inputs and settings by name; a ladder of other ones is not continued.
        resume: Continue an interrupted one.
        overwrite: Begin again where an interrupted one is.

    Raises:
        UsageError: If the directory holds something else, or an interrupted ladder and neither is set, or one that was
            made of something else, or if another process writes it.
    """

    def __init__(self, out: Path, made_of: Mapping[str, str], resume: bool, overwrite: bool) -> None:
        self._out, self.path = out, self.path_of(out)
        self._lock = DirectoryLock(self.path)
        if (self.path / _KEY).is_file():
            self._require_alone()
            if not resume and not overwrite:
                raise UsageError(
                    f"{self.path} holds a ladder of {out} that was interrupted.",
                    todo="pass --resume to go on with it, or --overwrite to begin again.",
                )
            if overwrite and not resume:
                self.remove()
            else:
                self._refuse_others(made_of)
        elif self.path.exists() and not all(_is_ours(entry.name) for entry in self.path.iterdir()):
            raise UsageError(
                f"{self.path} is in the way: an unfinished ladder goes there, and it holds none.",
                todo="move it, or choose another --out.",
            )
        if not (self.path / _KEY).is_file():
            self.path.mkdir(parents=True, exist_ok=True)
            self._require_alone()
            with replaced_file(self.path / _KEY) as path:
                path.write_text(json.dumps(dict(made_of), indent=1, sort_keys=True) + "\n", encoding="utf-8")

    @staticmethod
    def path_of(out: Path) -> Path:
        """Return the directory of an unfinished ladder."""
        return out.with_name(f"{out.name}.checkpoint")

    def __truediv__(self, name: str) -> Path:
        """Return the path of a file or model of the ladder."""
        return self.path / name

    def document(self, name: str, kind: type[DocumentT], make: Callable[[], DocumentT]) -> DocumentT:
        """Return a document from its file; it is made and written first if there is none."""
        path = self.path / name
        if not path.is_file():
            made = make().model_dump_json(indent=1) + "\n"
            with replaced_file(path) as partial:
                partial.write_text(made, encoding="utf-8")
        return read_json(path, kind)

    def remove(self) -> None:
        """Remove the directory, when the ladder is complete or is to begin again."""
        if (self.path / _KEY).is_file():
            remove_directory(self.path, self._out)
        self._lock.release()

    def _require_alone(self) -> None:
        if not self._lock.hold():
            raise UsageError(
                f"{self.path}: another process is writing the ladder of {self._out} now.",
                todo="wait until it has ended, or choose another --out.",
            )

    def _refuse_others(self, made_of: Mapping[str, str]) -> None:
        found = json.loads((self.path / _KEY).read_text(encoding="utf-8"))
        names = differing(found, made_of)
        if names:
            raise UsageError(
                f"{self.path} was made with other values of {', '.join(names)}.",
                "the same command, on the same capture, with --resume.",
                "pass what was passed before, or --overwrite to begin again.",
            )


def differing(found: Mapping[str, str], wanted: Mapping[str, str]) -> list[str]:
    """Return the names of inputs and settings that differ; of a table of settings, those in it.

    >>> differing({"split": "train", "improve": '{"steps":6,"folds":4}'}, {"improve": '{"steps":2,"folds":4}'})
    ['improve.steps', 'split']
    """
    names = []
    for name in sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key)):
        tables = [found.get(name, ""), wanted.get(name, "")]
        if all(text.startswith("{") for text in tables):
            first, second = map(json.loads, tables)
            names += sorted(f"{name}.{key}" for key in {*first, *second} if first.get(key) != second.get(key))
        else:
            names.append(name)
    return names
