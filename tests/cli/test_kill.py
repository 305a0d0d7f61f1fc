"""A command that is killed at any moment loses nothing, and the next run completes its work."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.kill_cases import CASES


@pytest.mark.evidence
@pytest.mark.parametrize("name", CASES)
def test_a_kill_at_random_moments_loses_nothing(name: str) -> None:
    # in a process of its own, which forks: this one has threads
    tests = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tests), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "helpers.kill_run", "50", "--only", name]
    # not in the root, whose folder cgwm/ would be found before the installed package
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tests)
    assert done.returncode == 0, done.stdout + done.stderr
