"""A fit that is interrupted goes on where it was, and gives what it would have given."""

import json
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from cgwm.datasets.io.directory_lock import NAME as LOCK_NAME
from cgwm.datasets.models.fit_inputs import photo_inputs
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.improve.ladder_files import LadderFiles
from cgwm.pipeline.optimization.adam import Adam
from cgwm.pipeline.runtime.checkpoint import Checkpoint
from cgwm.pipeline.sg_gs import bodies
from cgwm.pipeline.sg_gs.appearance import mcmc
from cgwm.pipeline.sg_gs.appearance import optimize as descents
from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement
from cgwm.pipeline.sg_gs.solid.visual_hull import carve
from cgwm.pipeline.sg_gs.stage import fit_scene
from cgwm.schemas import InputDataError, UsageError
from pipeline.sg_gs.test_sg_gs import CONFIG, make_capture

MADE_OF = {"settings": "a", "images": "b"}


class Interrupted(Exception):
    pass


def unrefined(hull, *_):
    """In the place of stereo, which takes long and is not what is tested."""
    return hull, Refinement(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture") / "tiny")


def test_a_state_comes_back_as_it_was(tmp_path):
    optimiser = Adam([{"params": [torch.ones(3, requires_grad=True)], "lr": 1e-3}])
    optimiser.param_groups[0]["params"][0].sum().backward()
    optimiser.step()
    state = {"adam": optimiser.state_dict(), "order": [3, 1], "rate": 0.1, "random": torch.Generator().get_state()}
    checkpoint = Checkpoint(tmp_path / "c", MADE_OF)
    checkpoint.write("ball: colours", state)
    back = checkpoint.read("ball: colours", torch.device("cpu"))
    assert back is not None
    assert back["order"] == [3, 1]
    assert back["rate"] == 0.1
    assert torch.equal(back["random"], state["random"])
    assert back["adam"]["param_groups"] == state["adam"]["param_groups"]
    assert torch.equal(back["adam"]["state"][0]["exp_avg"], state["adam"]["state"][0]["exp_avg"])
    assert checkpoint.read("ball colours", torch.device("cpu")) is None


ADAPTIVE = {"spheres": 250, "adaptive_iterations": 120, "sh_degree": 1}


@pytest.mark.parametrize("settings", [{}, pytest.param(ADAPTIVE, marks=pytest.mark.evidence)])
def test_a_resumed_fit_gives_the_same_spheres(tmp_path, capture, settings, monkeypatch):
    brief = {"iterations": 12, "joint": False, "max_scene_spheres": 100, "bare_ground": False}
    brief |= {"image_size": 48, "max_body_spheres": 80, "max_collision_spheres": 20, "flat_faces": False}
    config = CONFIG.model_copy(update={**brief, **settings})
    monkeypatch.setattr(mcmc, "REFINED_EVERY", 10)
    monkeypatch.setattr(bodies, "refine", unrefined)
    hulls = []
    # of the same photos each time
    monkeypatch.setattr(bodies, "carve", lambda *given: (hulls or hulls.append(carve(*given)) or hulls)[0])
    whole = fit_scene(capture, config, Checkpoint(tmp_path / "short", MADE_OF, every_s=600.0))
    assert not list(tmp_path.iterdir())  # nothing is written by a short fit
    for stopped_after in (3, 5):  # again and again, in the midst of one descent or another
        written = 0

        def write(self, name, state, plain=Checkpoint.write, most=stopped_after):
            nonlocal written
            plain(self, name, state)
            written += 1
            if written >= most:
                raise Interrupted

        with monkeypatch.context() as patch, pytest.raises(Interrupted):
            patch.setattr(Checkpoint, "write", write)
            fit_scene(capture, config, Checkpoint(tmp_path / "c", MADE_OF, every_s=0.0))
    steps = []
    plain_progress = descents.progress

    def counted(iterable, *arguments, **settings):
        steps.append(len(iterable))
        return plain_progress(iterable, *arguments, **settings)

    monkeypatch.setattr(descents, "progress", counted)
    resumed = fit_scene(capture, config, Checkpoint(tmp_path / "c", MADE_OF))
    assert sum(steps) < sum((3, 6, 9)[: len(steps)])  # shape, colours, background: it did not begin again
    np.testing.assert_array_equal(resumed.bodies["ball"].visual.means, whole.bodies["ball"].visual.means)
    np.testing.assert_array_equal(resumed.bodies["ball"].visual.colors, whole.bodies["ball"].visual.colors)
    np.testing.assert_array_equal(resumed.bodies["ball"].collision.means, whole.bodies["ball"].collision.means)
    np.testing.assert_array_equal(resumed.scene.means, whole.scene.means)
    np.testing.assert_array_equal(resumed.scene.scales, whole.scene.scales)
    assert resumed.record["ball"]["appearance_loss"] == whole.record["ball"]["appearance_loss"]


def test_what_was_interrupted_is_neither_lost_nor_mixed(tmp_path):
    out = tmp_path / "model"
    Checkpoint.beside(out, MADE_OF, resume=True, overwrite=False).write("background", {"k": 1})
    with pytest.raises(UsageError, match="pass --resume"):
        Checkpoint.beside(out, MADE_OF, resume=False, overwrite=False)
    with pytest.raises(UsageError, match="other settings"):
        Checkpoint.beside(out, MADE_OF | {"settings": "c"}, resume=True, overwrite=False)
    again = Checkpoint.beside(out, MADE_OF, resume=True, overwrite=False)
    assert again.read("background", torch.device("cpu")) == {"k": 1}
    stored = next(again.path.glob("*.npz"))
    for frame in ("", "{}", '{"dict": 1}', '{"tensor": []}', "[" * 10**6, '{"dict": [[[], 1]]}'):
        np.savez(stored, frame=np.array(frame))
        with pytest.raises(InputDataError, match="cannot be read"):
            again.read("background", torch.device("cpu"))
    stored.write_bytes(b"PK")
    with pytest.raises(InputDataError, match="cannot be read"):
        again.read("background", torch.device("cpu"))
    Checkpoint.beside(out, MADE_OF, resume=False, overwrite=True)
    assert not again.path.exists()


def test_what_another_process_is_writing_is_not_taken_for_interrupted(tmp_path):
    out = tmp_path / "run"
    mine = Checkpoint.beside(out, MADE_OF, resume=False, overwrite=False)
    mine.write("background", {"k": 1})
    ladder = LadderFiles(out.with_name("ladder"), MADE_OF, resume=False, overwrite=False)
    for one in (mine, ladder):
        one._lock.release()  # as of a process that was killed
        with held_by_another(one.path / LOCK_NAME):
            if one is mine:
                with pytest.raises(UsageError, match="another process is writing there"):
                    mine.write("background", {"k": 2})  # both began before either wrote
            for resume in (True, False):
                with pytest.raises(UsageError, match=r"another process is writing (a run|the ladder) of"):
                    if one is mine:
                        Checkpoint.beside(out, MADE_OF, resume=resume, overwrite=not resume, work="a run")
                    else:
                        LadderFiles(out.with_name("ladder"), MADE_OF, resume=resume, overwrite=not resume)
    assert Checkpoint.beside(out, MADE_OF, resume=True, overwrite=False).path.exists()
    assert LadderFiles(out.with_name("ladder"), MADE_OF, resume=False, overwrite=True).path.exists()


@contextmanager
def held_by_another(lock):
    """Hold a lock in another process."""
    hold = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, fcntl.LOCK_EX); print(flush=True); input()"
    command = [sys.executable, "-S", "-c", hold, str(lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        yield
        other.communicate(b"\n")


def test_a_folder_of_that_name_that_is_no_checkpoint_stays(tmp_path):
    folder = tmp_path / "model.checkpoint"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(UsageError):
        Checkpoint.beside(tmp_path / "model", MADE_OF, resume=False, overwrite=False)
    with pytest.raises(UsageError):
        Checkpoint.beside(tmp_path / "model", MADE_OF, resume=False, overwrite=True)
    assert (folder / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "left", [[], [".made_of.json.partial-999999999-11111111-0a.json"], ["ball-colours-0a1b2c3d.npz"]]
)
def test_what_a_kill_left_of_checkpoints_is_no_obstacle(tmp_path, left):
    """A process may die while it makes the folder, or while it removes it."""
    for finished in (False, True):
        folder = tmp_path / "model.checkpoint"
        folder.mkdir()
        for name in left:
            (folder / name).touch()
        if finished:
            Checkpoint.remove_of(tmp_path / "model", MADE_OF)
        else:
            Checkpoint.beside(tmp_path / "model", MADE_OF, resume=True, overwrite=False)
        assert not folder.exists()


@pytest.mark.evidence
def test_a_fit_that_is_killed_goes_on(tmp_path, capture):
    out = tmp_path / "model"
    lines = (
        "from cgwm.pipeline.runtime import checkpoint; from cgwm.pipeline.sg_gs import bodies; "
        "from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement; "
        "bodies.refine = lambda hull, *_: (hull, Refinement(0.0, 0.0, 0.0)); "
        "checkpoint.Checkpoint.__init__.__defaults__ = (0.0,); from cgwm.cli import main; main()"
    )
    fast = [f"sg-gs.{key}={value}" for key, value in (("max_body_spheres", 200), ("max_scene_spheres", 400))]
    fast += [
        "sg-gs.joint=false",
        "sg-gs.image_size=96",
        "sg-gs.iterations=80",
        "sg-gs.turntable=false",
        "sg-gs.exposure=false",
    ]
    command = ["fit", str(capture.root), "--stage", "sg-gs", "--device", "cpu", "--out", str(out), "--resume", "--json"]
    command += [word for setting in fast for word in ("--set", setting)]
    with subprocess.Popen([sys.executable, "-c", lines, *command], stderr=subprocess.PIPE) as process:
        end = time.monotonic() + 60
        while time.monotonic() < end and len(list(tmp_path.glob("model.checkpoint/ball-colours*.npz"))) == 0:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert not out.exists()
    first = next(tmp_path.glob("model.checkpoint/ball-shape*.npz")).read_bytes()
    assert first
    done = subprocess.run([sys.executable, "-c", lines, *command], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["bodies"][0]["name"] == "ball"
    assert read_model(out).scene is not None
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_a_checkpoint_is_made_of_shapes_and_cameras_of_colmap_too(tmp_path):
    capture = make_capture(tmp_path / "capture", shape='shape = { mesh = { path = "ball.obj" } }')
    (capture.root / "ball.obj").write_text("v 0 0 0\n")
    before = photo_inputs(capture, CONFIG)
    (capture.root / "ball.obj").write_text("v 0 0 1\n")
    model = capture.root / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        (model / name).write_text("# none\n")
    after = photo_inputs(capture, CONFIG)
    assert {name for name in after if after[name] != before.get(name)} == {"ball.obj", "sparse/0"}
