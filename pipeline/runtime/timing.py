"""Timing of stages: wall time by part, and busy time of the GPU."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ...datasets.io.progress import note
from ...schemas import CgwmError


class Stopwatch:
    """Stopwatch for the parts of a stage; each part belongs to one thread.

    Attributes:
        seconds: Wall time by part [s], without work of the GPU or of other threads that continues after the part.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def part(self, name: str, on_gpu: bool = False) -> Iterator[None]:
        """Measure the enclosed block; `on_gpu` also measures on the device, from the first to the last kernel."""
        events = (torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) if on_gpu else None
        if events is not None:
            events[0].record()
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
            if events is not None:
                events[1].record()
                self._events.append(events)

    def gpu_seconds(self) -> float:
        """Return an upper bound on the GPU's busy time in the measured parts [s]; gaps within a part count as busy."""
        if not self._events:
            return 0.0
        torch.cuda.synchronize()
        origin = self._events[0][0]
        spans = sorted((origin.elapsed_time(first), origin.elapsed_time(last)) for first, last in self._events)
        busy, reached = 0.0, spans[0][0]
        for first, last in spans:
            busy += max(0.0, last - max(first, reached))
            reached = max(reached, last)
        return busy / 1e3


@dataclass(frozen=True)
class StagedRun:
    """A run of `cgwm demo`, stage by stage."""

    folder: Path
    """Directory in which the stages write."""
    name: Path
    """Final name of the directory, which it gets when it is complete."""
    seconds: dict[str, float] = field(default_factory=dict, kw_only=True)
    """Wall time by stage [s]."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Announce and time a stage, and add its name to its errors."""
        note(f"demo: {name} ...")
        began = time.perf_counter()
        try:
            yield
        except CgwmError as error:
            raise self._named(error, name) from None
        self.seconds[name] = round(time.perf_counter() - began, 2)
        note(f"demo: {name}: {self.seconds[name]:.1f} s")

    def plain(self, message: str) -> str:
        """Replace the temporary name of the directory in a message by the final one."""
        return message.replace(str(self.folder), str(self.name))

    def _named(self, error: CgwmError, stage: str) -> CgwmError:
        found = f"the demo failed in the stage '{stage}' (nothing was left in {self.name}): {error.found}"
        return type(error)(self.plain(found), self.plain(error.allowed), self.plain(error.todo))
