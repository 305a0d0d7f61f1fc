"""`pytest --forks N`: the tests are collected once, and forks of that process run them, a file of tests at a time.

A worker with a Python of its own loads torch and collects all tests by itself, which takes a twentieth of the time of
the whole suite.
"""

from __future__ import annotations

import gc
import json
import os
import selectors
import signal
import struct
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, NoReturn

import pytest
from _pytest.tmpdir import TempPathFactory

_read, _write = os.read, os.write  # tests put others in their places
NUMBER = struct.Struct("<I")
"""A place in the list of files; what fits into a pipe at once is read at once, so that each is read by one fork."""


class Fork:
    """A process that runs tests, seen from that which started it."""

    def __init__(self, pid: int, source: int) -> None:
        self.pid, self.source, self.rest, self.done = pid, source, b"", False
        self.test: tuple[str, tuple[str, int | None, str]] | None = None
        """Name and place of the test that runs."""

    def messages(self) -> Iterator[list[Any]] | None:
        """Return what it has sent since; None when it has ended."""
        data = _read(self.source, 1 << 20)
        if not data:
            return None
        *lines, self.rest = (self.rest + data).split(b"\n")
        return map(json.loads, lines)


class Forks:
    """Plugin of pytest that shares out the tests."""

    def __init__(self, config: pytest.Config, count: int) -> None:
        self.config, self.count = config, count
        self.target: int | None = None
        """Where a fork sends what happens; None in the process that it is told to."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Run the tests in forks, and report what they send."""
        option = session.config.option
        if option.collectonly or (session.testsfailed and not option.continue_on_collection_errors):
            return None  # pytest lists the tests, or says which files cannot be read
        files = [list(items) for _, items in groupby(session.items, lambda item: item.path)]
        queue, fill = os.pipe()
        _write(fill, b"".join(map(NUMBER.pack, range(len(files)))))
        os.close(fill)
        factory: TempPathFactory = self.config._tmp_path_factory  # pyright: ignore[reportAttributeAccessIssue]
        base = factory.getbasetemp()
        gc.freeze()  # collections in the forks copy no pages of what is there
        forks = [self._forked(session, files, queue, base / f"fork{k}") for k in range(self.count)]
        try:
            self._collect(session, forks, queue)
        finally:
            for fork in forks:
                os.killpg(fork.pid, signal.SIGKILL)  # with what its tests have left running
                os.waitpid(fork.pid, 0)
            os.close(queue)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if session.shouldstop:
            raise session.Interrupted(session.shouldstop)
        return True

    def _forked(self, session: pytest.Session, files: list[list[pytest.Item]], queue: int, base: Path) -> Fork:
        source, target = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads: none that imports begin holds a lock
            pid = os.fork()
        if pid:
            os.setpgid(pid, pid)  # so that an interrupt from the terminal reaches this process alone
            os.close(target)
            return Fork(pid, source)
        os.close(source)
        self._run(session, files, queue, base, target)

    def _collect(self, session: pytest.Session, forks: list[Fork], queue: int) -> None:
        """Report what forks send until all have ended, or pytest wants no more."""
        with selectors.DefaultSelector() as selector:
            for fork in forks:
                selector.register(fork.source, selectors.EVENT_READ, fork)
            while selector.get_map():
                for key, _ in selector.select():
                    fork: Fork = key.data
                    messages = fork.messages()
                    for kind, *given in messages or ():
                        getattr(self, f"_on_{kind}")(fork, *given)
                    if messages is None or fork.done:
                        selector.unregister(fork.source)
                    if messages is None and not fork.done:
                        self._died(fork)
                if session.shouldfail or session.shouldstop:
                    return

    def _on_start(self, fork: Fork, nodeid: str, location: list[Any]) -> None:
        fork.test = nodeid, (location[0], location[1], location[2])
        self.config.hook.pytest_runtest_logstart(nodeid=nodeid, location=tuple(location))

    def _on_report(self, fork: Fork, data: dict[str, Any]) -> None:
        for name in ("location", "longrepr"):  # tuples, which JSON has not
            data[name] = tuple(data[name]) if isinstance(data[name], list) else data[name]
        data["sections"] = list(map(tuple, data["sections"]))
        report = self.config.hook.pytest_report_from_serializable(config=self.config, data=data)
        self.config.hook.pytest_runtest_logreport(report=report)

    def _on_finish(self, fork: Fork, nodeid: str, location: list[Any]) -> None:
        fork.test = None
        self.config.hook.pytest_runtest_logfinish(nodeid=nodeid, location=tuple(location))

    def _on_warning(self, fork: Fork, text: str, file: str, line: int, when: Any, nodeid: str) -> None:
        message = warnings.WarningMessage(UserWarning(text), UserWarning, file, line)
        called = {"warning_message": message, "when": when, "nodeid": nodeid, "location": None}
        self.config.hook.pytest_warning_recorded.call_historic(kwargs=called)

    def _on_end(self, fork: Fork, times: dict[str, Any]) -> None:
        fork.done = True
        plugin = self.config.pluginmanager.get_plugin("processor_time")
        if plugin is not None:
            plugin.take(times)

    def _died(self, fork: Fork) -> None:
        """Report a fork that has ended without a word as the failure of the test that it ran."""
        nodeid, location = fork.test or ("--forks", ("", None, "between two tests"))
        report = pytest.TestReport(nodeid, location, {}, "failed", "the process that ran it has died", "call")
        self.config.hook.pytest_runtest_logreport(report=report)

    # What follows is done in a fork

    def _run(
        self, session: pytest.Session, files: list[list[pytest.Item]], queue: int, base: Path, target: int
    ) -> NoReturn:
        try:
            os.setpgid(0, 0)
            self.target = target
            self._begin(base)
            waiting = deque(self._next(files, queue))
            while waiting:
                item = waiting.popleft()
                if not waiting:  # what comes next decides which fixtures end
                    waiting.extend(self._next(files, queue))
                self.config.hook.pytest_runtest_protocol(item=item, nextitem=waiting[0] if waiting else None)
            plugin = self.config.pluginmanager.get_plugin("processor_time")
            self._send("end", plugin.seen() if plugin is not None else {})
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(0)

    def _begin(self, base: Path) -> None:
        """Become a process of its own: streams, temporary folder, and no terminal to report to."""
        capture = self.config.pluginmanager.get_plugin("capturemanager")
        if capture is not None and capture.is_globally_capturing():
            capture.stop_global_capturing()
            capture.start_global_capturing()
        base.mkdir()
        self.config._tmp_path_factory._basetemp = base  # pyright: ignore[reportAttributeAccessIssue]
        self.config.pluginmanager.unregister(name="terminalreporter")

    def _next(self, files: list[list[pytest.Item]], queue: int) -> list[pytest.Item]:
        data = _read(queue, NUMBER.size)
        return files[NUMBER.unpack(data)[0]] if data else []

    def _send(self, *message: object) -> None:
        if self.target is not None:
            data = json.dumps(message).encode() + b"\n"
            while data:
                data = data[_write(self.target, data) :]

    def pytest_runtest_logstart(self, nodeid: str, location: tuple[str, int | None, str]) -> None:
        self._send("start", nodeid, location)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._send("report", self.config.hook.pytest_report_to_serializable(config=self.config, report=report))

    def pytest_runtest_logfinish(self, nodeid: str, location: tuple[str, int | None, str]) -> None:
        self._send("finish", nodeid, location)

    def pytest_warning_recorded(self, warning_message: warnings.WarningMessage, when: str, nodeid: str) -> None:
        text = f"{warning_message.category.__name__}: {warning_message.message}"
        self._send("warning", text, warning_message.filename, warning_message.lineno, when, nodeid)
