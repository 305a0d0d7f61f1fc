"""Commands run in the tests' own process: a process of its own begins with three seconds of imports."""

import io
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

import pytest
from cgwm.cli import main


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def cgwm(*words: object) -> Ended:
    """Run a command with these words, as a shell would."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    with warnings.catch_warnings(), redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    texts = (stream.buffer.getvalue().decode() for stream in (out, err))
    return Ended(int(ended.value.code or 0), *texts)
