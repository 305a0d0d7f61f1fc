"""A command that is interrupted, or killed outright, leaves nothing under its final name and can be run again."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.schemas import BodyModel, ContactParameters, Ground, ModelFile, Provenance

Case = tuple[list[str], Path]


def tosses(path: Path, count: int = 300) -> Path:
    """Write ballistic tosses in the layout of the published archive; 40 poses each, 148 Hz."""
    steps, rate_hz = 40, 148.0
    rng = np.random.default_rng(0)
    times = np.arange(steps) / rate_hz
    start, velocity = rng.uniform(0.2, 0.4, (count, 1, 3)), rng.uniform(-0.3, 0.3, (count, 1, 3))
    position = start + velocity * times[:, None] - 0.5 * 9.81 * times[:, None] ** 2 * np.array([0.0, 0.0, 1.0])
    path.mkdir()
    np.savez(
        path / "tosses.npz",
        offsets=np.arange(count + 1) * steps,
        pos=position.reshape(-1, 3),
        quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count * steps, 1)),
        vel=np.repeat(velocity, steps, axis=1).reshape(-1, 3),
        omega_body=np.zeros((count * steps, 3)),
        toss_index=np.arange(count),
        rate_hz=rate_hz,
        half_width_m=0.05,
    )
    return path


def import_case(folder: Path) -> Case:
    out = folder / "capture"
    # many, so that a slow machine still sends the signal while they are written
    return ["import", "contactnets", str(tosses(folder / "source", 3000)), "--out", str(out)], out


def demo_case(folder: Path) -> Case:
    out = folder / "demo"
    return ["demo", str(out)], out


def calibrate_case(folder: Path) -> Case:
    capture = folder / "capture"
    (capture / "images").mkdir(parents=True)
    (capture / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    texture = np.random.default_rng(0).integers(0, 255, (150, 200, 3)).astype(np.uint8)
    for k in range(12):
        photo = cv2.resize(np.roll(texture, 3 * k, axis=1), (1600, 1200), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(capture / "images" / f"{k:02d}.jpg"), photo)
    return ["calibrate", str(capture)], capture / "cameras.json"


def fit_case(folder: Path) -> Case:
    capture, out = folder / "capture", folder / "model"
    source = tosses(folder / "source", 60)
    subprocess.run([*CGWM, "import", "contactnets", str(source), "--out", str(capture)], check=True, timeout=120)
    # so long that a fast machine, too, is still at it when the signal comes
    return ["fit", str(capture), "--out", str(out), "--set", "phys-geo.generations=400"], out


def synthesize_case(folder: Path) -> Case:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(64, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    splats = Splats(means=ball, scales=np.full(64, 0.005), opacities=np.full(64, 0.9), colors=rng.random((64, 3)))
    body = BodyModel(
        name="ball", motion="free", mass_kg=0.1, inertia_kg_m2=(1e-4, 1e-4, 1e-4, 0, 0, 0), com_m=(0, 0, 0)
    )
    file = ModelFile(
        ground=Ground(), bodies=(body,), contact=ContactParameters(), provenance=Provenance(capture="made by a test")
    )
    write_model(folder / "model", Model(root=None, file=file, body_splats={"ball": splats}))
    out = folder / "dataset"
    return ["synthesize", str(folder / "model"), "--out", str(out), "--rollouts", "500"], out


CGWM = [sys.executable, "-m", "cgwm"]
# A parent in the background may have had SIGINT ignored, which a child inherits.
CGWM_INTERRUPTIBLE = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from cgwm.cli import main; main()",
]
WRITE_EARLY = ("demo", "synthesize", "import")
"""What makes its temporary output at once: on a slow machine too it is interrupted while it works, not while it loads
packages, where an interrupt can get lost."""
CASES: dict[str, Callable[[Path], Case]] = {
    "demo": demo_case,
    "calibrate": calibrate_case,
    "fit": fit_case,
    "synthesize": synthesize_case,
    "import": import_case,
}


SIGNALS = [
    pytest.param(verb, number, id=f"{verb}-{number.name}", marks=[pytest.mark.evidence] if late else [])
    for verb in CASES
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
    for late in [number == signal.SIGTERM and verb in ("demo", "calibrate", "fit")]
]
"""SIGTERM is handled by the same lines for all commands: the quick ones show it in the suite."""


def partial(out: Path) -> list[Path]:
    return list(out.parent.glob(".*partial*"))


@contextmanager
def started(command: list[str], **options: object) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command; whatever the test does, it is killed at the end: Popen's own end would wait for it."""
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def at_work(process: subprocess.Popen[bytes], out: Path, seconds: float) -> bool:
    """Wait until the command writes (its temporary output is there), or for so long."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not partial(out):
        if process.poll() is not None:
            return False
        time.sleep(0.01)
    return process.poll() is None


@pytest.mark.parametrize(("verb", "number"), SIGNALS)
def test_an_interrupted_command_leaves_nothing(verb: str, number: signal.Signals, tmp_path: Path) -> None:
    arguments, out = CASES[verb](tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    before = set(tmp_path.rglob("*"))
    environment = os.environ | {"TMPDIR": str(scratch)}
    command = [*CGWM_INTERRUPTIBLE, *arguments]
    with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
        assert at_work(process, out, 30.0 if verb in WRITE_EARLY else 4.0), process.communicate()[1].decode()
        process.send_signal(number)
        printed, said = process.communicate(timeout=60)
    assert not out.exists()
    assert printed == b""
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
        assert set(tmp_path.iterdir()) - before == set(partial(out))  # nothing but what is plainly unfinished
    else:
        assert process.returncode == 130
        assert said.decode() == "Interrupted; no output was written.\n"
        assert set(tmp_path.rglob("*")) == before


INTERRUPTED_WITHIN = """
import signal, sys, time
from cgwm.cli.execution import run_command

def app(*arguments, **options):
    try:
        signal.raise_signal(signal.SIGINT)
    {handler}
    time.sleep(60)

run_command(lambda: app, [])
"""


def test_an_interrupt_that_a_library_swallows_comes_again() -> None:
    code = INTERRUPTED_WITHIN.format(handler="except BaseException: pass")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stderr) == (130, "Interrupted; no output was written.\n")


def test_an_interrupt_does_not_come_again_while_its_work_is_cleaned_up() -> None:
    code = INTERRUPTED_WITHIN.format(handler="finally: time.sleep(1.2); print('cleaned up', file=sys.stderr)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stderr) == (130, "cleaned up\nInterrupted; no output was written.\n")


def test_a_killed_command_can_be_run_again(tmp_path: Path) -> None:
    arguments, out = import_case(tmp_path)
    with started([*CGWM, *arguments]) as process:
        assert at_work(process, out, 30.0)
        process.kill()
    assert len(partial(out)) == 1
    subprocess.run([*CGWM, *arguments], check=True, capture_output=True, timeout=240)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "source"]
    assert (out / "capture.toml").is_file()
