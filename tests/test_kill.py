"""A command that is killed at any moment loses nothing, and the next run completes its work."""

from pathlib import Path

import pytest
from kill_run import COMMANDS, kill_often


@pytest.mark.evidence
@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_at_random_moments_loses_nothing(name: str, tmp_path: Path) -> None:
    assert kill_often(name, tmp_path, 50) == []
