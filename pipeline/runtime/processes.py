"""Tasks in several processes of this machine, each with its share of the cores.

A Python process runs Python code in one thread at a time, whatever the number of cores.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn

from ...schemas import CgwmError

GRACE_S = 10.0
"""Time for interrupted processes to remove unfinished files [s]."""
LOOK_UP_S = 0.5
"""Interval [s] at which the waiting thread checks for interrupts that reached another thread."""


def in_workers(
    task: Callable[..., Any], calls: Mapping[int, tuple[Any, ...]], count: int
) -> Generator[tuple[int, Any], None, None]:
    """Run a task in several processes, and yield number and result of each call in the order of completion.

    Processes that still run when the generator is closed, or left by an error, are interrupted.

    Args:
        task: Function of a module, because processes are spawned.
        calls: Arguments of each call, by number; arguments and results are pickled.
        count: Maximum number of processes.

    Raises:
        CgwmError: If a process dies, with the number of its call.
        Exception: Any exception that a task raises.
    """
    context = multiprocessing.get_context("spawn")  # CUDA does not survive a fork
    count = min(count, len(calls))
    waiting = deque(calls)
    processes: dict[Connection, Any] = {}
    busy: dict[Connection, int] = {}
    try:
        for number in range(count):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(task, there, share_of_cores(number, count)), daemon=True)
            with _no_interrupts():
                process.start()
            there.close()
            processes[here] = process
            _hand_out(here, calls, waiting, busy)
        while busy:
            ready = set(wait(list(busy), LOOK_UP_S))
            for connection in [one for one in busy if one in ready]:
                number = busy.pop(connection)
                try:
                    outcome, error = connection.recv()
                except (EOFError, ConnectionError):
                    raise _died(number, processes[connection]) from None
                if error is not None:
                    raise error
                _hand_out(connection, calls, waiting, busy)
                yield number, outcome
    finally:
        _end(processes, busy)


def share_of_cores(number: int, count: int) -> list[int]:
    """Return the cores for one of several processes; empty where the system does not report the cores."""
    if not hasattr(os, "sched_getaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    if count >= len(cores):
        return [cores[number % len(cores)]]
    return cores[len(cores) * number // count : len(cores) * (number + 1) // count]


def _hand_out(
    connection: Connection, calls: Mapping[int, tuple[Any, ...]], waiting: deque[int], busy: dict[Connection, int]
) -> None:
    if waiting:
        busy[connection] = waiting.popleft()
        with suppress(OSError):  # if the process has died, its connection reports that later
            connection.send(calls[busy[connection]])


def _work(task: Callable[..., Any], connection: Connection, cores: Sequence[int]) -> None:
    """Run the calls that arrive over a connection, until it closes."""
    signal.signal(signal.SIGTERM, _interrupt)
    os.environ["CGWM_QUIET"] = "1"  # only the parent shows a progress bar
    if cores:
        os.sched_setaffinity(0, cores)
    with suppress(KeyboardInterrupt, EOFError, ConnectionError):
        while True:
            arguments = connection.recv()
            try:
                answer = task(*arguments), None
            except Exception as error:
                answer = None, error
            connection.send(answer)


def _interrupt(number: int, frame: object) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # once: a second one must not interrupt the clean-up
    raise KeyboardInterrupt


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, as the parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(processes: Mapping[Connection, Any], busy: Mapping[Connection, int]) -> None:
    for connection, process in processes.items():
        if connection in busy:
            process.terminate()
        connection.close()  # idle processes end by themselves
    for process in processes.values():
        process.join(GRACE_S)
        if process.is_alive():
            process.kill()
            process.join()


def _died(number: int, process: Any) -> CgwmError:
    process.join()
    code = process.exitcode
    how = f"by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"with exit code {code}"
    return CgwmError(
        f"shard {number}: its process ended {how}.",
        todo="see whether memory ran out (dmesg), take fewer --workers, and run the command again with --resume, "
        "which keeps the complete shards.",
    )
