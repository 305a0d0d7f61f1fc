"""Where a stage's time goes: seconds by part, and how long a GPU worked."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Stopwatch:
    """Adds up the seconds of a stage's parts; each part belongs to one thread.

    Attributes:
        seconds: By part. What a part gives to the GPU or to other threads goes on after it.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def part(self, name: str, on_gpu: bool = False) -> Iterator[None]:
        """Measure what is inside; `on_gpu` also measures on the device, from its first to its last kernel."""
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
        """Return how long the GPU was busy with the measured parts: at most, as gaps within a part count as work."""
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
