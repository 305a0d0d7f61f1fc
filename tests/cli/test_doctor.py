"""What `cgwm doctor` finds, and what it says when something is missing."""

import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata

import pytest
import torch
from cgwm.datasets.io.processors import processors
from cgwm.pipeline.runtime import doctor as module
from cgwm.pipeline.runtime import kernel_build
from cgwm.pipeline.runtime.doctor import doctor, memory_bytes, satisfies
from cgwm.schemas import DoctorReport


def set_version(monkeypatch: pytest.MonkeyPatch, package: str, version: str | None) -> None:
    found = module._version
    monkeypatch.setattr(module, "_version", lambda name: version if name == package else found(name))


def test_the_machine_that_runs_the_tests_is_ready() -> None:
    report = doctor()
    assert report.ready
    assert report.missing == ()
    assert report.hdf5_zstd
    assert report.aruco
    assert report.colmap == metadata.version("pycolmap")
    assert report.cgwm == metadata.version("cgwm")
    assert {package.name for package in report.packages} >= {"torch", "mujoco", "pycolmap", "typer", "h5py"}
    assert report.cpu_cores == processors() >= 1
    assert 0.5 * 2**30 < memory_bytes() < 2**50
    assert DoctorReport.model_validate_json(report.model_dump_json()) == report


def test_a_missing_package_comes_with_its_pip_line(monkeypatch: pytest.MonkeyPatch) -> None:
    set_version(monkeypatch, "mujoco", None)
    monkeypatch.setattr(module, "_load", lambda name: None)
    monkeypatch.setattr(module, "_broken", lambda packages: [])
    report = doctor()
    assert not report.ready
    (missing,) = report.missing
    assert missing.what == "mujoco"
    assert missing.why == "not installed"
    assert missing.todo == "pip install 'mujoco<4,>=3.17'"
    assert report.colmap is None
    assert report.cuda_devices == ()


def test_a_package_that_is_too_new_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    set_version(monkeypatch, "mujoco", "4.0.0")
    (missing,) = doctor().missing
    assert missing.why == "found 4.0.0, needed mujoco<4,>=3.17"


def test_a_package_that_does_not_import_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> object:
        if name == "cv2":
            raise ImportError("libGL.so.1: cannot open shared object file")
        return __import__(name)

    monkeypatch.setattr(module, "import_module", load)
    (missing,) = doctor().missing
    assert missing.what == "opencv-python-headless"
    assert missing.why == "does not import: libGL.so.1: cannot open shared object file"


@pytest.mark.parametrize(
    ("version", "requirement", "expected"),
    [
        ("2.13.0+cpu", "torch<3,>=2.11", True),
        ("2.9.1", "torch<3,>=2.11", False),
        ("3.17", "mujoco>=3.17.0", True),
        ("4.0.0", "mujoco<4,>=3.17", False),
        ("1.2.3", "thing", True),
        ("1.2.3", "thing!=1.2.3", False),
        ("10.0", "thing>9.9", True),
    ],
)
def test_versions_against_bounds(version: str, requirement: str, expected: bool) -> None:
    assert satisfies(version, requirement) is expected


@pytest.fixture
def device_without_cuda_core(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine with a CUDA device on which no kernel can be built."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index=0: "a device")
    monkeypatch.setattr(kernel_build, "_core", lambda: None)
    for cached in (kernel_build.unavailable, kernel_build.available):
        cached.cache_clear()
    yield
    for cached in (kernel_build.unavailable, kernel_build.available):
        cached.cache_clear()


@pytest.mark.usefixtures("device_without_cuda_core")
def test_a_device_whose_kernels_cannot_run_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    assert not kernel_build.available()
    assert not kernel_build.available()
    (record,) = caplog.records
    assert "cannot run on a device: cuda-core 1.0 or later" in record.getMessage()
    assert "pip install 'cuda-core>=1.0,<2'" in record.getMessage()
    assert "cuda-core" in doctor().uses["renderer"]


def test_a_warning_reaches_stderr_that_is_no_terminal() -> None:
    code = """
import logging, sys, typer
from cgwm.cli.execution import running
with running(quiet="quiet" in sys.argv):
    logging.getLogger("of.a.library").warning("nobody reads this")
    logging.getLogger("cgwm").warning("it is slow because of %s", "this")
"""
    said = [
        subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True).stderr
        for words in ([], ["quiet"])
    ]
    assert said == ["Warning: it is slow because of this\n", ""]


def test_each_extra_says_what_it_lacks_and_what_it_is_for(monkeypatch: pytest.MonkeyPatch) -> None:
    set_version(monkeypatch, "rosbags", None)
    set_version(monkeypatch, "viser", "0.2.0")
    set_version(monkeypatch, "usd-core", "26.11")
    extras = {one.name: one for one in doctor().extras}
    provided = set(metadata.metadata("cgwm").get_all("Provides-Extra") or [])
    assert set(extras) == provided - {"dev", "docs", "benchmarks"}
    (line,) = extras["ros"].missing
    assert line.startswith("rosbags") and extras["ros"].purpose == "cgwm import rosbag"
    assert [one.startswith("viser") for one in extras["view"].missing] == [True]
    assert extras["usd"].missing == ()


def test_a_shell_completes_verbs() -> None:
    environment = os.environ | {"_CGWM_COMPLETE": "complete_bash", "COMP_WORDS": "cgwm cal", "COMP_CWORD": "1"}
    script = "import sys; sys.argv[0] = 'cgwm'; from cgwm.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["calibrate"], done.stderr
