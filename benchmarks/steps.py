"""Steps of a benchmark that wait for each other, on one pool of processes; from a certain time on none begins."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field
from typing import Any


@dataclass(eq=False)
class Step:
    """A call in another process.

    Args:
        work: The function; what it raises ends the run, unless `spoils`.
        arguments: Returns its arguments, just before it begins.
        needs: Steps that must be done before.
        done: Takes its result, in this process.
        spoils: Takes the exception of a step that may fail; the steps that need it are left out.
    """

    work: Callable[..., Any]
    arguments: Callable[[], tuple[Any, ...]]
    needs: Sequence[Step] = ()
    done: Callable[[Any], object] = lambda _: None
    spoils: Callable[[BaseException], object] | None = None
    state: str = field(default="waiting", init=False)
    """waiting, running, done or failed."""


def run_steps(pool: Executor, steps: Sequence[Step], workers: int, seconds: float = float("inf")) -> int:
    """Run steps, the first in order that can begin, and return how many are left.

    Args:
        pool: Who works.
        steps: The steps; one that needs a failed one has failed, too.
        workers: How many run at once.
        seconds: None begins later than so many seconds from now.
    """
    deadline, running = time.monotonic() + seconds, dict[Future[Any], Step]()
    while True:
        for step in steps:
            if step.state == "waiting" and any(one.state == "failed" for one in step.needs):
                step.state = "failed"
        ready = [s for s in steps if s.state == "waiting" and all(one.state == "done" for one in s.needs)]
        begin = ready[: workers - len(running)] if time.monotonic() < deadline else []
        for step in begin:
            step.state = "running"
            running[pool.submit(step.work, *step.arguments())] = step
        if not running:
            return sum(step.state == "waiting" for step in steps)
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            _finish(running.pop(future), future)


def _finish(step: Step, future: Future[Any]) -> None:
    error = future.exception()
    if error is None:
        step.state = "done"
        step.done(future.result())
    elif step.spoils is None:
        raise error
    else:
        step.state = "failed"
        step.spoils(error)
