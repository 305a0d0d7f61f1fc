"""A command that is interrupted, or killed outright, leaves nothing under its final name and can be run again."""

import random
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.cli import main
from cgwm.datasets import import_contactnets
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.schemas import BodyModel, ContactParameters, Ground, ModelFile, Provenance
from helpers.forked import Forked, forked
from helpers.target_photos import write_photos

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
    return ["import", "contactnets", str(tosses(folder / "source", 1500)), "--out", str(out)], out


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


def target_case(folder: Path) -> Case:
    photos = folder / "photos"
    write_photos(photos, 8)
    for k in range(300):
        shutil.copyfile(photos / f"{k % 8:02d}.png", photos / f"again-{k:03d}.png")
    return ["calibrate", str(photos), "--target", "charuco"], photos / "intrinsics.json"


def fit_case(folder: Path) -> Case:
    capture, out = folder / "capture", folder / "model"
    source = tosses(folder / "source", 60)
    import_contactnets(source, capture)
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


WRITE_EARLY = ("demo", "synthesize", "import")
"""What makes its temporary output at once: on a slow machine too it is interrupted while it writes."""
CASES: dict[str, Callable[[Path], Case]] = {
    "demo": demo_case,
    "calibrate": calibrate_case,
    "target": target_case,
    "fit": fit_case,
    "synthesize": synthesize_case,
    "import": import_case,
}


SIGNALS = [
    pytest.param(verb, number, id=f"{verb}-{number.name}", marks=[pytest.mark.evidence] if late else [])
    for verb in CASES
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
    for late in [verb != "import" and (number != signal.SIGINT or verb in ("target", "demo", "synthesize"))]
]
"""One handler serves all commands: the suite sends all signals to one, and SIGINT to those that work otherwise."""


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


def at_work(process: Forked, out: Path, seconds: float) -> bool:
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
    with Forked(*arguments, environment={"TMPDIR": str(scratch)}) as process:
        assert at_work(process, out, 30.0 if verb in WRITE_EARLY else 1.0), process.printed()
        process.send_signal(number)
        ended = process.ended(60)
    assert not out.exists()
    assert ended.stdout == ""
    if number == signal.SIGKILL:
        assert ended.returncode == -signal.SIGKILL
        assert set(tmp_path.iterdir()) - before == set(partial(out))  # nothing but what is plainly unfinished
    else:
        assert ended.returncode == 130
        assert ended.stderr == "Interrupted; no output was written.\n"
        assert set(tmp_path.rglob("*")) == before


WITHIN = """
import atexit, os, signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
from cgwm.cli import interrupts
from cgwm.cli.execution import run_command, running, typer

class Result:
    def model_dump_json(self, indent):
        return "{{}}"

def hit():
    os.kill(os.getpid(), {number})

def verb():
{body}

app = typer.Typer(pretty_exceptions_enable=False)
app.command()(verb)
with interrupts.caught(owned=True):
    run_command(lambda: app, [])
"""


def ended(body: str, number: int = signal.SIGINT) -> tuple[int, str, str]:
    """Run a command whose function has this body; return exit code, stdout and stderr."""
    code = WITHIN.format(body=textwrap.indent(textwrap.dedent(body), "    "), number=int(number))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout, done.stderr


def working(inside: str = "", last: str = "", after: str = "") -> str:
    """Return the body of a verb: its work, what follows its result, and what follows its end."""
    work = textwrap.indent(f"{inside}\nemit(Result(), lambda result: 'the result')\n{last}", "    ")
    return f"with running() as emit:\n{work}\n{after}"


NOTHING = (130, "", "Interrupted; no output was written.\n")
DONE = (0, "the result\n", "")
AT_TEARDOWN = "sys.late = type('Late', (), {'__del__': lambda self, hit=hit: hit()})()"
IN_A_THREAD = "import threading; threading.Thread(target=lambda: (time.sleep(0.2), hit())).start()"
SWALLOWED = "try: hit()\nexcept BaseException: pass\ntime.sleep(60)"


@pytest.mark.parametrize(
    ("moment", "number", "outcome"),
    [
        pytest.param("hit(); time.sleep(60)", signal.SIGINT, NOTHING, id="while it starts", marks=pytest.mark.evidence),
        pytest.param(SWALLOWED, signal.SIGHUP, NOTHING, id="while it starts, in a library that catches everything"),
        pytest.param(working(inside="hit()"), signal.SIGTERM, NOTHING, id="while it works"),
        pytest.param(
            working(last="hit()"), signal.SIGINT, NOTHING, id="before its result is printed", marks=pytest.mark.evidence
        ),
        pytest.param(working(after="hit()"), signal.SIGTERM, DONE, id="after its result"),
        pytest.param(
            working(after="atexit.register(hit)"), signal.SIGINT, DONE, id="at the exit", marks=pytest.mark.evidence
        ),
        pytest.param(working(after=IN_A_THREAD), signal.SIGHUP, DONE, id="while a thread ends"),
        pytest.param(working(after=AT_TEARDOWN), signal.SIGINT, DONE, id="while the interpreter is taken down"),
    ],
)
def test_a_signal_at_every_moment(moment: str, number: signal.Signals, outcome: tuple[int, str, str]) -> None:
    assert ended(moment, number) == outcome


def test_a_result_is_printed_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")  # a write that a signal meets then takes only a part
    body = """
        import threading
        from cgwm.cli import execution
        def often():
            for _ in range(100): hit(); time.sleep(0.001)
        as_before = execution.print_result
        execution.print_result = lambda *given: (threading.Thread(target=often).start(), as_before(*given))
        with running() as emit: emit(Result(), lambda result: "x" * 8_000_000)
    """
    code, printed, said = ended(body)
    assert (code, len(printed), said) == (0, 8_000_001, "")


def test_an_interrupt_that_a_library_swallows_comes_again() -> None:
    assert ended(working(inside=SWALLOWED)) == NOTHING


def test_an_interrupt_does_not_come_again_while_its_work_is_cleaned_up(tmp_path: Path) -> None:
    cleaned = tmp_path / "cleaned"
    assert ended(working(f"try: hit()\nfinally:\n    time.sleep(1.2)\n    open({str(cleaned)!r}, 'w')")) == NOTHING
    assert cleaned.exists()


def test_an_interrupted_command_names_the_outputs_that_it_has_completed(tmp_path: Path) -> None:
    out = tmp_path / "model"
    write = (
        "from pathlib import Path\nfrom cgwm.datasets.io.atomic import new_directory\n"
        f"with new_directory(Path({str(out)!r}), 'model') as folder: (folder / 'x').touch()\nhit()"
    )
    assert ended(working(write)) == (130, "", f"Interrupted; {out} is complete.\n")
    assert (out / "x").is_file()


def test_a_caller_of_the_command_keeps_its_process_and_its_handlers() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ending:
        main(["--version"])
    assert (ending.value.code, (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))) == (0, before)


MARKED = """
import os, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from cgwm.cli import interrupts, main
begin = interrupts.caught.__enter__
interrupts.caught.__enter__ = lambda self: (begin(self), os.write(1, b"begins\\n"))[0]
main()
"""


@pytest.mark.evidence
@pytest.mark.parametrize("arguments", [["--version"], ["effects", "list"]], ids=" ".join)
def test_two_hundred_signals_at_random_moments(arguments: list[str]) -> None:
    """From the first line that cgwm can run; what comes before is Python's start."""
    command, chance, outcomes = [sys.executable, "-c", MARKED, *arguments], random.Random(0), Counter()
    began = time.monotonic()
    whole = subprocess.run(command, capture_output=True, check=True).stdout
    seconds = time.monotonic() - began
    for _ in range(100):
        number = chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
        with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            first = process.stdout.readline()
            time.sleep(chance.uniform(0, seconds))
            process.send_signal(number)
            printed, said = process.communicate(timeout=60)
        outcomes[(process.returncode, first + printed if first + printed == whole else printed, said)] += 1
    allowed = {(0, whole, b""), (130, b"", NOTHING[2].encode()), (130, whole, NOTHING[2].encode())}
    assert set(outcomes) <= allowed and outcomes.total() == 100, outcomes


def test_a_killed_command_can_be_run_again(tmp_path: Path) -> None:
    arguments, out = import_case(tmp_path)
    with Forked(*arguments) as process:
        assert at_work(process, out, 30.0)
        process.kill()
        process.wait()
    assert len(partial(out)) == 1
    assert forked(*arguments).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "source"]
    assert (out / "capture.toml").is_file()
