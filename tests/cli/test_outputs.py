"""`--overwrite` replaces an output of cgwm of the same kind, and never an input or anything else of the user's."""

import hashlib
import json
import multiprocessing
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.cli.app import app
from cgwm.datasets.importers.csv_tracks import import_csv
from cgwm.datasets.importers.hdf5_tracks import import_hdf5
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.compare import compare
from cgwm.pipeline.demo import run_demo, run_mystery
from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.export import export
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.effects.catalogue import new_effect
from cgwm.pipeline.synthesize import merge, synthesize
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.schemas import CgwmError, SynthesizeConfig, UsageError
from helpers.forked import Forked
from helpers.small_model import small_model
from typer.testing import CliRunner, Result

from cgwm import improve

TINY = SynthesizeConfig(rollouts=2, duration_s=0.1, width=20, height=16)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one of everything: recordings, a capture, a model, datasets, exports, and the user's own."""
    root = tmp_path_factory.mktemp("things") / "data"
    (root / "csv").mkdir(parents=True)
    for name in ("a", "b", "c"):
        rows = [f"{t:.3f},0,0,{1 - 4.9 * t * t:.6f},1,0,0,0" for t in np.arange(0, 0.3, 0.01)]
        (root / "csv" / f"{name}.csv").write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]) + "\n")
    with h5py.File(root / "poses.h5", "w") as file:
        file["time_s"], file["position_m"] = np.arange(5) / 10, np.zeros((5, 3))
        file["quat_wxyz"] = np.tile([1.0, 0, 0, 0], (5, 1))
    import_csv(root / "csv", root / "capture")
    write_model(root / "model", small_model())
    synthesize(root / "model", root / "dataset", TINY)
    synthesize_shards(root / "model", root / "shards", TINY.model_copy(update={"shards": 2}))
    merge([root / "shards"])
    (root / "docs").mkdir()
    (root / "docs" / "thesis.txt").write_text("years of work")
    (root / "notes.html").write_text("<!doctype html>mine")
    (root / "mine.py").write_text("mine")
    return root


@pytest.fixture
def things(originals: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of `originals`, and a home directory beside it."""
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return shutil.copytree(originals, tmp_path / "data", symlinks=True)


def content(root: Path) -> dict[str, str]:
    found = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "a folder"
    return found


def stamps(root: Path) -> dict[str, object]:
    """Return what tells whether a file was written or replaced, by name: in a twentieth of the time of its content."""
    found: dict[str, object] = {}
    for path in sorted(root.rglob("*")):
        seen = path.stat()
        identity = seen.st_ino, seen.st_mtime_ns, seen.st_size
        found[path.relative_to(root).as_posix()] = identity if path.is_file() else "a folder"
    return found


COMMANDS: dict[str, tuple[Callable[[Path, Path], object], set[str]]] = {
    "fit": (lambda root, out: fit(root / "capture", out, overwrite=True), {"model"}),
    "import csv": (lambda root, out: import_csv(root / "csv", out, overwrite=True), {"capture"}),
    "import csv of a capture": (lambda root, out: import_csv(root / "capture" / "tracks", out, overwrite=True), set()),
    "import hdf5": (lambda root, out: import_hdf5(root / "poses.h5", out, overwrite=True), {"capture"}),
    "synthesize": (lambda root, out: synthesize(root / "model", out, TINY, overwrite=True), {"dataset", "shards"}),
    "compare": (lambda root, out: compare([root / "model"], root / "capture", out=out, overwrite=True), set()),
    "diagnose": (lambda root, out: diagnose(root / "model", root / "capture", save_law_to=out, overwrite=True), set()),
    "improve": (lambda root, out: improve(root / "capture", out, overwrite=True), set()),
    "merge": (lambda root, out: merge([root / "shards"], out, overwrite=True), {"dataset", "shards/index.h5"}),
    "merge inside": (lambda root, out: merge([root / "shards"], overwrite=True), set()),
    "demo": (lambda root, out: run_demo(out, overwrite=True), set()),
    "mystery": (lambda root, out: run_mystery(out, overwrite=True), set()),
    "effects new": (lambda root, out: new_effect(out, overwrite=True), set()),
    "export ply": (lambda root, out: export(root / "model", "ply", out, overwrite=True), set()),
    "export mjcf": (lambda root, out: export(root / "model", "mjcf", out, overwrite=True), set()),
    "export glb": (lambda root, out: export(root / "model", "glb", out, overwrite=True), set()),
    "export colmap": (lambda root, out: export(root / "model", "colmap", out, overwrite=True), set()),
    "export bop": (lambda root, out: export(root / "dataset", "bop", out, overwrite=True), set()),
    "export nerfstudio": (lambda root, out: export(root / "dataset", "nerfstudio", out, overwrite=True), set()),
    "export lerobot": (lambda root, out: export(root / "dataset", "lerobot", out, overwrite=True), set()),
}
"""A call of each command that writes, and the outputs of its own kind among `things`, which it may replace."""
FAST = {"import csv", "import hdf5"}
"""Commands that are quick enough to replace an output of their kind here."""


@pytest.mark.parametrize("command", COMMANDS)
def test_only_an_output_of_the_same_kind_is_replaced(things: Path, command: str) -> None:
    call, own = COMMANDS[command]
    before = stamps(things)
    tried = 0
    for name in [*before, "."]:
        out = things / name
        if (name in own and command not in FAST) or not out.exists():
            continue
        if name in own:
            assert stamps(things) == before, f"{command}: a refusal before {name}"
        try:
            call(things, out)
        except CgwmError as error:
            assert error.exit_code in (1, 2), error
        else:
            if command == "merge inside":
                return  # it has one output, of its own
            assert name in own, f"{command} --out {name} was taken"
            before = stamps(things)
        tried += 1
    assert tried > 20
    after = stamps(things)
    assert after == before, {name for name in {*after, *before} if after.get(name) != before.get(name)}


def test_an_output_that_the_user_has_touched_stays(things: Path) -> None:
    capture = things / "capture"
    import_csv(things / "csv", capture, overwrite=True)
    (capture / "photo.jpg").write_bytes(b"mine")
    with pytest.raises(UsageError, match=r"capture holds photo\.jpg, which cgwm did not write"):
        import_csv(things / "csv", capture, overwrite=True)
    (capture / "photo.jpg").unlink()
    manifest = capture / "capture.toml"
    manifest.write_text(manifest.read_text() + "# a ball of 60 g\n")
    with pytest.raises(UsageError, match=r"capture holds capture\.toml, which was changed since cgwm wrote it"):
        import_csv(things / "csv", capture, overwrite=True)


def test_cameras_of_ones_own_in_an_imported_capture_stay(things: Path) -> None:
    capture = things / "capture"
    for name, text in (
        ("cameras.json", '{"format": "cgwm-cameras/1"}'),
        ("sparse_points.ply", "mine"),
        ("calibration.json", "{}"),
    ):
        (capture / name).write_text(text)
        before = content(things)
        with pytest.raises(UsageError, match=r"which cgwm did not write"):
            import_csv(things / "csv", capture, overwrite=True)
        assert content(things) == before
    (capture / "calibration.json").write_text('{"format": "cgwm-calibration/1"}')  # now all of it is `calibrate`'s
    import_csv(things / "csv", capture, overwrite=True)
    assert not (capture / "cameras.json").exists()


def test_two_commands_that_write_one_output_at_once_do_not_mix_it(things: Path) -> None:
    other = things / "other"
    other.mkdir()
    for file in (things / "csv").iterdir():
        (other / file.name).write_text(file.read_text().replace(",1,0,0,0", ",0,1,0,0"))
    want = {}
    for source in ("csv", "other"):
        said = CliRunner().invoke(app, ["import", "csv", str(things / source), "--out", str(things / f"by_{source}")])
        assert said.exit_code == 0, said.output
        want[source] = content(things / f"by_{source}")
    for number, overwrite in enumerate(([], ["--overwrite"], ["--overwrite"])):
        out = things / f"out{number // 2}"
        words = [("import", "csv", things / source, "--out", out, *overwrite) for source in ("csv", "other")]
        start = multiprocessing.get_context("fork").Barrier(2)
        with Forked(*words[0], before=start.wait) as one, Forked(*words[1], before=start.wait) as two:
            ended = {"csv": one.ended(60), "other": two.ended(60)}
        codes = {source: one.returncode for source, one in ended.items()}
        assert set(codes.values()) <= {0, 1, 2} and 0 in codes.values(), ended
        assert all("Internal error" not in one.stderr and "Traceback" not in one.stderr for one in ended.values())
        assert content(out) in [want[source] for source, code in codes.items() if code == 0]
        assert not list(things.glob(".*partial*")) + list(things.glob(".*replaced*"))


def test_a_new_output_may_lie_in_the_folder_of_an_input_but_not_among_its_files(things: Path) -> None:
    export(things / "model", "ply", things / "model" / "splats")
    with pytest.raises(UsageError, match="would lie among the files of an input"):
        export(things / "model", "glb", things / "model" / "splats" / "all.glb")
    with pytest.raises(UsageError, match="holds an input of this command"):
        import_csv(things / "capture" / "tracks", things / "capture", overwrite=True)


def test_a_link_to_an_input_is_an_input(things: Path) -> None:
    (things / "link").symlink_to(things / "model")
    with pytest.raises(UsageError, match="is an input of this command"):
        synthesize(things / "model", things / "link", TINY, overwrite=True)


def test_an_index_typed_twice_is_written_again_and_another_one_refused(things: Path) -> None:
    words = ["merge", str(things / "shards"), "--out", str(things / "joined.h5")]
    assert CliRunner().invoke(app, words).exit_code == 0
    written = (things / "joined.h5").read_bytes()
    assert CliRunner().invoke(app, words).exit_code == 0
    assert (things / "joined.h5").read_bytes() == written
    other = [*words[:1], str(things / "dataset"), *words[2:]]
    assert CliRunner().invoke(app, other).exit_code == 2
    assert (things / "joined.h5").read_bytes() == written


def test_an_import_typed_twice_is_kept_and_another_one_refused(things: Path) -> None:
    words = ["import", "csv", str(things / "csv"), "--out", str(things / "twice")]

    def typed(*more: str) -> Result:
        return CliRunner().invoke(app, [*words, *more])

    assert typed().exit_code == 0
    before = content(things / "twice")
    again = typed()
    assert (again.exit_code, again.stdout) == (0, f"{things / 'twice'} is already the result of this command.\n")
    assert json.loads(typed("--json").stdout) == {"output": str(things / "twice"), "kept": True}
    assert content(things / "twice") == before
    track = next((things / "csv").iterdir())
    old = track.read_text()
    track.write_text(old + "\n")
    assert typed().exit_code == 2
    track.write_text(old)
    (things / "twice" / "mine.txt").write_text("mine")
    assert typed().exit_code == 2
