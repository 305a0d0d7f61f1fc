"""Import of tosses of an elbow: both links lie on their hinge; folders and archives; refusals."""

import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets import Capture, import_elbow
from cgwm.schemas import InputDataError, UsageError
from helpers.elbow import toss, write_tosses
from scipy.spatial.transform import Rotation


def test_links_lie_on_their_hinge_at_its_angle(tmp_path: Path) -> None:
    result = import_elbow(write_tosses(tmp_path / "data", [3, 1, 12]), tmp_path / "out", n_train=2, n_test=1, seed=5)
    assert (result.episodes, result.samples, result.splits) == (3, 36, {"train": 2, "test": 1})
    capture = Capture.open(tmp_path / "out")
    assert capture.body_names == ["upper", "lower"] and capture.episodes() == ["001", "003", "012"]
    rows, tracks = toss(12), capture.tracks("012")
    upper, lower = (Rotation.from_quat(tracks[name].quat_wxyz, scalar_first=True) for name in ("upper", "lower"))
    np.testing.assert_allclose((upper.inv() * lower).as_rotvec(), rows[:, 7:8] * [0, 1, 0], atol=1e-12)
    between = upper.inv().apply(tracks["lower"].position_m - tracks["upper"].position_m)
    np.testing.assert_allclose(between, np.broadcast_to([-0.035, 0.06, 0.0], between.shape), atol=1e-12)
    np.testing.assert_allclose(tracks["upper"].position_m, rows[:, 4:7])
    np.testing.assert_allclose(np.diff(tracks["upper"].time_s), 0.0068)


def test_an_archive_is_its_folder(tmp_path: Path) -> None:
    folder = write_tosses(tmp_path / "data", [0, 1])
    with tarfile.open(tmp_path / "data.tar.xz", "w:xz") as archive:
        archive.add(folder, "elbow_tosses")
    for source, out in ((folder, "a"), (tmp_path / "data.tar.xz", "b")):
        import_elbow(source, tmp_path / out)
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert {str(file) for file in files} >= {"capture.toml", "elbow.urdf", "tracks/000.csv", "tracks/001.csv"}
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    with pytest.raises(UsageError, match="exists"):
        import_elbow(folder, tmp_path / "a")


def _without(suffix: str) -> Callable[[Path], object]:
    return lambda folder: [path.unlink() for path in list(folder.rglob(f"*{suffix}"))]


def _saved(values: object) -> Callable[[Path], object]:
    return lambda folder: torch.save(values, folder / "tosses" / "0.pt")


def _replaced(old: str, new: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        path = folder / "elbow.urdf"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without(".pt"), "no tosses"),
        (_without(".urdf"), "URDF files: none"),
        (lambda folder: (folder / "tosses" / "0.pt").rename(folder / "tosses" / "a.pt"), "is no toss number"),
        (lambda folder: (folder / "tosses" / "0.pt").write_bytes(b"x"), "not a tensor that can be read safely"),
        (_saved(torch.zeros(4, 14)), r"\(4, 14\) where a toss was expected"),
        (_saved(torch.full((4, 15), torch.nan)), "4 frames, or numbers that are not finite"),
        (_saved(torch.ones(4, 15)), "a quaternion has norm 2.0000"),
        (_replaced('continuous">', "prismatic\"><limit lower='0' upper='1'/>"), r"its joints are hinge \(slide\)"),
        (_replaced("continuous", "planar"), "planar"),
    ],
)
def test_what_is_no_such_data_is_refused(tmp_path: Path, change: Callable[[Path], object], message: str) -> None:
    folder = write_tosses(tmp_path / "data", [0, 1])
    change(folder)
    with pytest.raises(InputDataError, match=message):
        import_elbow(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tar").write_bytes(b"no archive")
    with pytest.raises(InputDataError, match=r"a\.tar: it is no archive"):
        import_elbow(tmp_path / "a.tar", tmp_path / "out")
