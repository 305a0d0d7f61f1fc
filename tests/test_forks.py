"""Tests shared out to forks: each runs once, and what fails, is skipped or dies is said."""

import subprocess
import sys
from pathlib import Path

HELPERS = Path(__file__).parent
PLUGIN = f"""
import sys
sys.path.insert(0, {str(HELPERS)!r})
from helpers.forks import Forks
def pytest_configure(config):
    config.pluginmanager.register(Forks(config, 2), "forks")
"""
FIRST = """
import os, warnings, pytest
@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")
def test_a(shared): (shared / "a").touch()
def test_b(shared): assert (shared / "a").exists()
def test_c(): print("seen of c"); warnings.warn("heed me"); assert os.getpid() == 0
def test_d(): pytest.skip("not here")
"""
SECOND = """
import os
def test_e(): pass
def test_f(): os.kill(os.getpid(), 9)
def test_g(): pass
"""


def test_each_test_runs_once_and_a_process_that_dies_is_a_failure(tmp_path: Path) -> None:
    for name, text in (("conftest", PLUGIN), ("test_first", FIRST), ("test_second", SECOND)):
        (tmp_path / f"{name}.py").write_text(text)
    command = [sys.executable, "-m", "pytest", "-rA", "-p", "no:cacheprovider", str(tmp_path)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert "2 failed, 3 passed, 1 skipped, 1 warning" in ended.stdout
    for said in ("PASSED test_first.py::test_b", "FAILED test_first.py::test_c", "seen of c", "UserWarning: heed me"):
        assert said in ended.stdout
    assert "FAILED test_second.py::test_f - the process that ran it has died" in ended.stdout
    assert "test_g" not in ended.stdout
