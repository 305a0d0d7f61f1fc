"""A run of several stages into one directory: announced, timed, and with errors that name the stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ..datasets.progress import note
from ..schemas import CgwmError


@dataclass(frozen=True)
class StagedRun:
    """A run of `cgwm demo`.

    Attributes:
        folder: Where the stages write.
        name: What the user calls it: the name that the folder has when all of it is complete.
        seconds: Wall time by stage [s].
    """

    folder: Path
    name: Path
    seconds: dict[str, float] = field(default_factory=dict, kw_only=True)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce a stage, time it, and let its errors name it."""
        note(f"demo: {name} ...")
        began = time.perf_counter()
        try:
            yield
        except CgwmError as error:
            raise self._named(error, name) from None
        self.seconds[name] = round(time.perf_counter() - began, 2)
        note(f"demo: {name}: {self.seconds[name]:.1f} s")

    def plain(self, message: str) -> str:
        """Return a message without the name that the directory has while it is being written."""
        return message.replace(str(self.folder), str(self.name))

    def _named(self, error: CgwmError, stage: str) -> CgwmError:
        found = f"the demo failed in the stage '{stage}' (nothing was left in {self.name}): {error.found}"
        return type(error)(self.plain(found), self.plain(error.allowed), self.plain(error.todo))
