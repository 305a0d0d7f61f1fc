"""A command that is killed at any moment loses nothing, and the next run completes its work."""

import subprocess
import sys
from pathlib import Path

import pytest
from kill_cases import CASES


@pytest.mark.evidence
@pytest.mark.parametrize("name", CASES)
def test_a_kill_at_random_moments_loses_nothing(name: str) -> None:
    # in a process of its own, which forks: this one has threads
    command = [sys.executable, str(Path(__file__).with_name("kill_run.py")), "50", "--only", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
