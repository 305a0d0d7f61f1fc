"""Datasets and exports read by their formats' own readers, each in an environment of its own that pip makes.

Evidence: it downloads (LeRobot's environment takes 1 to 6 GB, by which torch there is). Everything runs in a directory
outside the clone. `CGWM_READER_ENVIRONMENTS=DIR` keeps the environments there; `CGWM_BOP_TOOLKIT` is what pip installs
for bop_toolkit, which is on no index, for example a directory with a clone of it.
"""

import json
import os
import subprocess
import sys
import venv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.datasets.exports.selection import Selection
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.rollouts.control_file import read_runs
from cgwm.datasets.rollouts.dataset import read_manifest
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.pipeline.control import control
from cgwm.pipeline.synthesize import synthesize
from cgwm.schemas import SynthesizeConfig, task_toml
from helpers.jointed_model import HEIGHT_M, jointed_model
from helpers.pushing import push_task, pushed_model
from helpers.small_model import MASS, write_small_model

READERS = Path(__file__).with_name("readers")
CPU_WHEELS = "https://download.pytorch.org/whl/cpu"
BOP_TOOLKIT = os.environ.get("CGWM_BOP_TOOLKIT", "git+https://github.com/thodan/bop_toolkit")
# what the loaders import, and no more: their own lists have simulators, viewers and models
LEROBOT = ("lerobot==0.4.4", "accelerate", "psutil", "pyyaml", "safetensors", "einops", "jsonlines", "termcolor")
LEROBOT_WHOLE = (
    "datasets>=4,<5",
    "huggingface-hub>=0.34.2,<0.36",
    "av>=15,<16",
    "draccus==0.10.0",
    "deepdiff>=7.0.1,<9",
)
LEROBOT_WHOLE += ("packaging>=24.2,<26", "numpy<2.4")
ROBOMIMIC_WHOLE = ("h5py", "hdf5plugin", "numpy", "psutil", "tqdm", "termcolor", "setuptools")
NERFSTUDIO_WHOLE = ("numpy", "tyro", "rich", "jaxtyping", "opencv-python-headless", "pillow", "imageio", "viser")
NERFSTUDIO_WHOLE += ("tensorboard", "setuptools<81")
BOP_WHOLE = ("numpy<2", "imageio", "pypng", "pytz", "pillow", "scipy", "scikit-image")

pytestmark = pytest.mark.evidence

Environment = Callable[..., Path]


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """Make a virtual environment of a name, or take it from an earlier run; return its Python."""
    kept = os.environ.get("CGWM_READER_ENVIRONMENTS")
    root = Path(kept) if kept else tmp_path_factory.mktemp("environments")

    def make(name: str, whole: Sequence[str], alone: Sequence[str] = (), torch: Sequence[str] = ()) -> Path:
        folder, python = root / name, root / name / "bin" / "python"
        wanted = json.dumps([whole, alone, torch])
        if (folder / "ready.json").is_file() and (folder / "ready.json").read_text() == wanted:
            return python
        venv.create(folder, with_pip=True, clear=True)
        steps = [[[*whole]], [["--no-deps", *alone]]] if alone else [[[*whole]]]
        if torch:
            cpu = [f"{package}+cpu" for package in torch]
            steps.insert(0, [cpu, [*cpu, "--extra-index-url", CPU_WHEELS], [*torch]])
        for alternatives in steps:
            done = [pip(python, *words) for words in alternatives[:1]]
            for words in alternatives[1:]:
                done += [pip(python, *words)] if done[-1].returncode else []
            assert done[-1].returncode == 0, done[-1].stderr
        (folder / "ready.json").write_text(wanted)
        return python

    return make


def pip(python: Path, *words: str) -> subprocess.CompletedProcess[str]:
    words = ("-m", "pip", "install", "--quiet", *words)
    return subprocess.run([python, *words], env=clean(), capture_output=True, text=True, check=False)


def clean() -> dict[str, str]:
    """Return the environment's variables without this Python's own path, where pip would find packages."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory outside the clone with a model and a dataset of six rollouts."""
    root = tmp_path_factory.mktemp("work")
    config = SynthesizeConfig(rollouts=6, duration_s=0.5, width=128, height=96, device="cpu", seed=5)
    synthesize(write_small_model(root / "model"), root / "dataset", config)
    return root


def cgwm(work: Path, *words: str) -> dict[str, Any]:
    """Run the command outside the clone; return what it says."""
    done = subprocess.run(
        [sys.executable, "-m", "cgwm", *words, "--json"], cwd=work, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def read_by(python: Path, reader: str, work: Path, *words: object) -> dict[str, Any]:
    """Run a reader's script outside the clone; return what it found."""
    done = subprocess.run(
        [python, READERS / f"{reader}_reader.py", *map(str, words)],
        cwd=work,
        env={**clean(), "HF_HUB_OFFLINE": "1", "HF_HOME": str(work / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    print(json.dumps(found, indent=1))
    return found


def test_lerobot_reads_the_export(environment: Environment, work: Path) -> None:
    python = environment("lerobot", LEROBOT_WHOLE, LEROBOT, ("torch==2.6.0", "torchvision==0.21.0"))
    cgwm(work, "export", "dataset", "--to", "lerobot", "--out", "lerobot", "--overwrite")
    found = read_by(python, "lerobot", work, "lerobot", work / "lerobot.npz")
    reader = RolloutReader(work / "dataset")
    count = reader.rollouts[0].frames
    assert (found["episodes"], found["frames"], found["fps"]) == (6, 6 * count, 30)
    assert found["shapes"]["observation.images.view0"] == [96, 128, 3]
    assert found["batch"]["observation.images.view1"] == [4, 2, 3, 96, 128]
    assert found["batch"]["observation.state"] == [4, 2, 13] and found["clips"] == 2 * count
    arrays = np.load(work / "lerobot.npz")
    for number in range(6):
        for row, frame in ((2 * number, 0), (2 * number + 1, count - 1)):
            assert (arrays["episode_index"][row], arrays["frame_index"][row]) == (number, frame)
            assert arrays["timestamp"][row] == pytest.approx(frame / 30, abs=1e-6)
            state = reader.read(number, "obs/object")[frame]
            np.testing.assert_allclose(arrays["observation.state"][row], state, rtol=1e-6)
            for view in ("view0", "view1"):
                image = arrays[f"observation.images.{view}"][row].transpose(1, 2, 0) * 255
                master = reader.read(number, f"obs/{view}_image")
                error = ((master.astype(float) - image) ** 2).mean((1, 2, 3))
                psnr = 10 * np.log10(255**2 / error[frame])
                print(f"episode {number} frame {frame} {view}: {psnr:.1f} dB against the HDF5 file")
                # that frame and no other; one before may be as near where the body rests
                assert psnr > 28 and error[frame] < 1.05 * error.min()
    reader.close()


def test_robomimic_reads_the_shard_as_it_is(environment: Environment, work: Path) -> None:
    python = environment("robomimic", ROBOMIMIC_WHOLE, ("robomimic==0.3.0",), (f"torch=={pinned('torch')}",))
    (shard,) = (entry.file for entry in read_manifest(work / "dataset").shards)
    found = read_by(python, "robomimic", work, work / "dataset" / shard, work / "robomimic.npz")
    reader = RolloutReader(work / "dataset")
    count = reader.rollouts[0].frames
    assert found["demos"] == {"train": [f"demo_{k}" for k in (0, 1, 2, 3, 5)], "valid": ["demo_4"]}
    assert found["sequences"] == {"train": 5 * count, "valid": count}
    assert found["batch"] == {
        "object": [4, 5, 13],
        "view0_image": [4, 5, 96, 128, 3],
        "view1_image": [4, 5, 96, 128, 3],
    }
    arrays = np.load(work / "robomimic.npz")
    # item k: one stacked frame before it and four of the sequence, the first repeated where there is none before
    for item in (0, 7):
        frames = np.clip(np.arange(item - 1, item + 4), 0, None)
        for name in ("object", "view0_image", "view1_image"):
            master = reader.read(0, f"obs/{name}")
            np.testing.assert_array_equal(arrays[f"{item}/obs/{name}"], master[frames])
            np.testing.assert_array_equal(arrays[f"{item}/next_obs/{name}"], master[frames + 1])
        np.testing.assert_array_equal(arrays[f"{item}/actions"], reader.read(0, "actions")[frames])
    reader.close()


def test_robomimic_reads_runs_of_control(environment: Environment, work: Path) -> None:
    python = environment("robomimic", ROBOMIMIC_WHOLE, ("robomimic==0.3.0",), (f"torch=={pinned('torch')}",))
    write_model(work / "cube", pushed_model(visible=False))
    easy = push_task(goal={"position_m": [0.1, 0.0]}, success={"timeout_s": 0.3})
    (work / "push.toml").write_text(task_toml(easy))
    control(work / "cube", work / "push.toml", work / "run", clock="ideal", seeds=2)
    found = read_by(python, "robomimic_runs", work, work / "run" / "run.h5", "object,finger")
    arrays = read_runs(work / "run" / "run.h5")[0].arrays
    count = len(arrays["actions"])
    assert found["None"]["demos"] == ["demo_0", "demo_1"] and found["None"]["sequences"] == 2 * count
    assert found["None"]["shapes"] == {"object": [3, 7], "finger": [3, 2]}
    np.testing.assert_allclose(found["None"]["next_object"], arrays["next_obs/object"][1:4, :3], rtol=1e-6)
    assert found["success"] == {"demos": [], "sequences": 0}


def test_nerfstudio_reads_the_export(environment: Environment, work: Path) -> None:
    """A ray through the pixel where our camera sees a body meets that body; pixels, depth and masks agree."""
    python = environment("nerfstudio", NERFSTUDIO_WHOLE, ("nerfstudio==1.1.5",), (f"torch=={pinned('torch')}",))
    words = ("--rollout", "2", "--mask", "scene", "--every", "3", "--overwrite")
    cgwm(work, "export", "dataset", "--to", "nerfstudio", "--out", "nerfstudio", *words)
    chosen = Selection(work / "dataset", every=3)
    bodies = chosen.reader.read(2, "bodies/pos")[:, 0]
    places = {f"{view}/{k:06d}.png": (view, k) for view in chosen.cameras for k in chosen.frames(2)}
    asked = {name: chosen.camera(2, view, k).project(bodies[k : k + 1])[0][0] for name, (view, k) in places.items()}
    np.savez(work / "asked.npz", **asked)
    found = read_by(python, "nerfstudio", work, "nerfstudio", work / "nerfstudio.npz", work / "asked.npz")
    assert sorted(found["images"]) == sorted(places) and found["scale"] == 1
    np.testing.assert_array_equal(found["transform"], np.eye(4)[:3])
    arrays = np.load(work / "nerfstudio.npz")
    for name, (view, k) in places.items():
        away = bodies[k] - arrays[f"{name}/origin"]
        across = np.linalg.norm(np.cross(away, arrays[f"{name}/direction"]))
        assert across < 1e-5, f"{name}: the ray passes the body {across * 1e3:.3f} mm away"
        master = {key: chosen.reader.read(2, f"obs/{view}_{key}")[k] for key in ("image", "depth", "mask")}
        np.testing.assert_allclose(arrays[f"{name}/image"] * 255, master["image"], atol=0.01)
        np.testing.assert_allclose(arrays[f"{name}/depth"], master["depth"], atol=0.00051)
        np.testing.assert_array_equal(arrays[f"{name}/mask"], master["mask"] == 0)
    chosen.reader.close()


def test_bop_toolkit_reads_the_export(environment: Environment, work: Path) -> None:
    try:
        python = environment("bop", BOP_WHOLE, (BOP_TOOLKIT,))
    except AssertionError as error:
        pytest.skip(f"bop_toolkit cannot be installed from {BOP_TOOLKIT} (set CGWM_BOP_TOOLKIT): {error}")
    cgwm(work, "export", "dataset", "--to", "bop", "--out", "bop", "--overwrite")
    found = read_by(python, "bop", work, "bop")
    assert found["scenes"] == 6 and found["images_checked"] > 20 and found["image_size"] == [128, 96]
    assert np.mean(found["corners_on_mask"]) > 0.97 and max(found["depth_beyond_model_mm"]) < 5
    assert found["diameter_mm"] == pytest.approx(found["diameter_by_toolkit_mm"], rel=1e-4)


def test_two_gltf_readers_read_the_export(environment: Environment, work: Path) -> None:
    python = environment("gltf", ("pygltflib", "trimesh", "numpy"))
    cgwm(work, "export", "model", "--to", "glb", "--out", "m.glb", "--overwrite")
    found = read_by(python, "glb", work, "m.glb")
    model = read_model(work / "model")
    assert found["nodes"] == ["world", "scene", "cube"] and model.scene is not None
    cube = found["meshes"]["cube"]["attributes"]
    opacity, scale = cube["KHR_gaussian_splatting:OPACITY"], cube["KHR_gaussian_splatting:SCALE"]
    body = model.body_splats["cube"]
    assert opacity == [400, 1, pytest.approx(body.opacities.sum(), rel=1e-5)]
    assert scale == [400, 3, pytest.approx(3 * body.scales.sum(), rel=1e-5)]
    # in the world, then with y up
    x, y, z = body.means.mean(0) + model.file.bodies[0].photo_pose.position_m
    np.testing.assert_allclose(found["clouds"]["cube"]["mean"], [x, z, -y], atol=1e-6)
    x, y, z = model.scene.means.mean(0)
    np.testing.assert_allclose(found["clouds"]["scene"]["mean"], [x, z, -y], atol=1e-6)


def test_drake_reads_the_world(environment: Environment, work: Path) -> None:
    python = environment("drake", ("numpy", "pyyaml", "pydot", "matplotlib"), ("drake==1.51.1",))
    write_model(work / "arm", jointed_model("fixed", (-0.5, 1.0), cube=True))
    cgwm(work, "export", "arm", "--to", "sdf", "--out", "sdf")
    found = read_by(python, "sdf", work, work / "sdf" / "world.sdf", 0.4)
    assert found["gravity"] == [0, 0, -9.81] and found["actuators"] == 0
    assert found["joints"]["elbow"] == ["RevoluteJoint", -0.5, 1.0]
    assert found["bodies"]["cube/link"][:4] == pytest.approx([MASS, 0.3, 0, 0.05])
    turned = [np.cos(0.4), 0, -np.sin(0.4)]  # the hinge is about y
    assert found["bodies"]["arm/lower"] == pytest.approx([0.3, 0.1, 0, HEIGHT_M, *turned])


def pinned(package: str) -> str:
    lines = (Path(__file__).parents[3] / "constraints.txt").read_text().splitlines()
    return next(line.split("==")[1] for line in lines if line.startswith(f"{package}=="))
