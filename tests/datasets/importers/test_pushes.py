"""Import of pushes: the text of MLab_EXP, and the keys of MIT push."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets import Capture, check_capture, import_pushes
from cgwm.schemas import InputDataError


def text_of(pushes: int = 2) -> str:
    """Pushes along x by a finger turned by 135 degrees: its left-handed sensor reads the force along x and -y."""
    half = np.deg2rad(135.0) / 2
    finger = f"{np.cos(half):.12f} 0 0 {np.sin(half):.12f}"
    one = ["562 139 9 1 0 0 0", "572 143 9 0.6 0 0 0.8", "3", "100.0 0.5 0.25", "101.0 0.5 0.25", "102.0 4.5 1.25"]
    one += ["3", *(f"{100 + k}.0 {500 + 10 * k} 30 21 {finger}" for k in range(3))]
    return "\n".join([str(pushes), *one * pushes]) + "\n"


def fault(tmp_path: Path, text: str, name: str = "a.txt") -> str:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputDataError) as caught:
        import_pushes(tmp_path / name, tmp_path / "refused")
    assert not (tmp_path / "refused").exists()
    return str(caught.value).replace(str(tmp_path), "T")


def test_a_push_of_mlab(tmp_path: Path) -> None:
    (tmp_path / "day.txt").write_text(text_of())
    result = import_pushes(tmp_path / "day.txt", tmp_path / "out", n_train=1)
    assert (result.episodes, result.samples, result.splits) == (2, 10, {"train": 1, "test": 1})
    assert "shapes, materials" in result.warnings[0]
    capture = Capture.open(tmp_path / "out")
    check_capture(capture)
    tracks = capture.tracks("day-01")
    np.testing.assert_allclose(tracks["object"].position_m, [[0.562, 0.139, 0.009], [0.572, 0.143, 0.009]])
    np.testing.assert_allclose(tracks["object"].time_s, [0, 2])
    np.testing.assert_allclose(tracks["finger"].position_m[:, 0], [0.5, 0.51, 0.52])
    assert tracks["finger"].force_n is not None
    np.testing.assert_allclose(tracks["finger"].force_n, [[0, 0, 0], [0, 0, 0], [4, -1, 0]], atol=1e-9)


def test_a_push_of_mit(tmp_path: Path) -> None:
    rows = [[0.0, 0.1, 0.2, 0.0], [0.0, 0.1, 0.2, 0.0], [1.0, 0.3, 0.2, np.pi / 2]]
    data = {"tip_pose": rows, "object_pose": rows, "ft_wrench": [[0.0, 0, 0, 0], [1.0, 2.0, -1.0, 0.1]]}
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.json").write_text(json.dumps(data))
    with h5py.File(tmp_path / "in" / "b.h5", "w") as file:
        for key, value in data.items():
            file[key] = np.array(value)
    import_pushes(tmp_path / "in", tmp_path / "out")
    capture = Capture.open(tmp_path / "out")
    check_capture(capture)
    for name in ("a-00", "b-00"):
        tracks = capture.tracks(name)
        np.testing.assert_allclose(tracks["object"].position_m, [[0.1, 0.2, 0], [0.3, 0.2, 0]])
        np.testing.assert_allclose(np.abs(tracks["object"].quat_wxyz[1]), np.sqrt([0.5, 0, 0, 0.5]), atol=1e-12)
        assert tracks["finger"].force_n is not None
        np.testing.assert_allclose(tracks["finger"].force_n[1], [2, -1, 0], atol=1e-12)


def test_what_is_no_push_is_refused(tmp_path: Path) -> None:
    good = text_of()
    assert fault(tmp_path, good.replace("4.5", "far")).startswith("T/a.txt, line 7: 'far' is no number.")
    assert fault(tmp_path, good.replace("4.5", "nan")).startswith("T/a.txt, line 7: 'nan' is no number.")
    assert fault(tmp_path, good[:-20]).startswith("T/a.txt: the file ends within poses of the finger, ")
    assert fault(tmp_path, good + "7\n").startswith("T/a.txt: 1 numbers follow the last push.")
    assert fault(tmp_path, "1.5\n").startswith("T/a.txt: 1.5 as the number of pushes.")
    assert fault(tmp_path, "1e300\n").startswith("T/a.txt: 1e+300 as the number of pushes.")
    assert fault(tmp_path, "0\n").startswith("T/a.txt: no pushes.")
    assert fault(tmp_path, "").startswith(
        "T/a.txt: the file ends within the number of pushes, 0 numbers are left of 1."
    )
    assert "quaternions have another norm" in fault(tmp_path, good.replace("0.6 0 0 0.8", "0.6 0 0 0.9"))
    assert fault(tmp_path, "[1]", "a.json").startswith("T/a.json: no table of keys.")
    assert fault(tmp_path, "{}", "a.json").startswith("T/a.json: no 'tip_pose'.")
    assert fault(tmp_path, '{"tip_pose": [[1, "x"]]}', "a.json").startswith("T/a.json: 'tip_pose' is (0, 0).")
    assert fault(tmp_path, good, "a.dat").startswith("T/a.dat: no pushes by its ending.")


def test_one_file_of_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "all" / "in"
    folder.mkdir(parents=True)
    for name in ("a", "b"):
        (folder / f"{name}.txt").write_text(text_of())
    assert import_pushes(folder, tmp_path / "both").episodes == 4
    assert import_pushes(folder, tmp_path / "one", only="b").episodes == 2
    assert import_pushes(folder.parent, tmp_path / "nested", only="a").episodes == 2
    with tarfile.open(tmp_path / "all.tar.xz", "w:xz") as archive:
        archive.add(folder.parent, "all")
    import_pushes(tmp_path / "all.tar.xz", tmp_path / "packed", only="a")
    manifests = [(tmp_path / name / "capture.toml").read_text() for name in ("nested", "packed")]
    assert "in_a-00" in manifests[0] and manifests[0] == manifests[1]
    with tarfile.open(tmp_path / "empty.tar", "w") as archive:
        archive.add(tmp_path / "packed" / "capture.toml", "capture.toml")
    with pytest.raises(InputDataError, match=r"empty\.tar: no pushes in it"):
        import_pushes(tmp_path / "empty.tar", tmp_path / "none")
    groups = {entry.group for entry in Capture.open(tmp_path / "nested", check=False).manifest.episodes.values()}
    assert groups == {"in_a"}
    with pytest.raises(InputDataError, match=r"--only c: no file of this name\.\nAllowed: a, b\."):
        import_pushes(folder, tmp_path / "none", only="c")
