"""Import of ContactNets' tosses: units, frames and splits, from files made here and from the published ones."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets import Capture, import_contactnets
from cgwm.schemas import InputDataError, UsageError

SHARED = Path(os.environ.get("CGWM_SHARED_DATA", Path(__file__).parents[4] / "shared" / "data"))
TOSSES = SHARED / "cube_tosses"
HALF_WIDTH = 0.0524


def rows(seed: int, count: int = 4) -> np.ndarray:
    """Return a toss in SI units, shape (T, 13)."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, 13))
    values[:, 3:7] /= np.linalg.norm(values[:, 3:7], axis=1, keepdims=True)
    return values


def write_pt(folder: Path, numbers: list[int]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        values = rows(number)
        values[:, [0, 1, 2, 7, 8, 9]] /= HALF_WIDTH
        tensor = torch.from_numpy(np.concatenate([values, np.zeros((len(values), 6))], axis=1))[None]
        torch.save(tensor, folder / f"{number}.pt")


def write_npz(path: Path, numbers: list[int], **change: object) -> None:
    values = np.concatenate([rows(number) for number in numbers])
    arrays = {
        "offsets": np.arange(len(numbers) + 1) * 4,
        "pos": values[:, :3],
        "quat_wxyz": values[:, 3:7],
        "vel": values[:, 7:10],
        "omega_body": values[:, 10:],
        "toss_index": np.array(numbers),
        "rate_hz": 148.0,
        "half_width_m": HALF_WIDTH,
    }
    np.savez(path, **{name: np.asarray(value) for name, value in (arrays | change).items() if value is not None})


@pytest.mark.parametrize("kind", ["pt", "pt in tosses", "npz", "npz in a folder"])
def test_sources_give_the_same_si_units(tmp_path: Path, kind: str) -> None:
    numbers = [2, 0, 10]
    source = tmp_path / "source"
    source.mkdir()
    if kind.startswith("pt"):
        write_pt(source / "tosses" if "in" in kind else source, numbers)
    else:
        write_npz(source / "a.npz", numbers)
        source = source if "in" in kind else source / "a.npz"
    result = import_contactnets(source, tmp_path / "out")
    capture = Capture.open(tmp_path / "out")
    assert capture.episodes() == ["000", "002", "010"]
    assert (result.episodes, result.samples, result.splits) == (3, 12, {"train": 1, "test": 2})
    for number in numbers:
        track, expected = capture.tracks(f"{number:03d}")["cube"], rows(number)
        assert track.velocity_m_s is not None and track.omega_body_rad_s is not None and track.quat_wxyz is not None
        np.testing.assert_allclose(track.time_s, np.arange(4) / 148)
        np.testing.assert_allclose(track.position_m, expected[:, :3], rtol=1e-14)
        np.testing.assert_allclose(track.quat_wxyz, expected[:, 3:7], rtol=1e-12)
        np.testing.assert_allclose(track.velocity_m_s, expected[:, 7:10], rtol=1e-14)
        np.testing.assert_allclose(track.omega_body_rad_s, expected[:, 10:], rtol=1e-14)


def test_manifest_is_that_of_the_cube(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", [0, 1])
    import_contactnets(tmp_path / "a.npz", tmp_path / "out")
    manifest = Capture.open(tmp_path / "out").manifest
    (cube,) = manifest.bodies
    assert cube.name == "cube" and cube.mass_kg == 0.37 and cube.inertia_kg_m2 == (0.00081, 0.00081, 0.00081)
    assert cube.shape is not None and cube.shape.box is not None
    assert cube.shape.box.half_extents_m == (0.0524, 0.0524, 0.0524)
    assert manifest.world.ground is not None and manifest.world.ground.offset_m == 0.0
    assert manifest.measurement.position_std_m is None


def test_splits_are_the_stated_permutation(tmp_path: Path) -> None:
    numbers = [5 * k for k in range(40)]
    write_npz(tmp_path / "a.npz", numbers[::-1])
    import_contactnets(tmp_path / "a.npz", tmp_path / "out", n_train=5, n_test=10, seed=7)
    splits = Capture.open(tmp_path / "out").manifest.splits
    order = [f"{numbers[k]:03d}" for k in np.random.default_rng(7).permutation(40)]
    assert list(splits["train"]) == order[:5] and list(splits["test"]) == order[5:15]
    import_contactnets(tmp_path / "a.npz", tmp_path / "few")
    splits = Capture.open(tmp_path / "few").manifest.splits
    order = [f"{numbers[k]:03d}" for k in np.random.default_rng(0).permutation(40)]
    assert list(splits["train"]) == order[:13] and list(splits["test"]) == order[13:]


class Evil:
    """What a stranger's file may try to run when it is unpickled."""

    def __reduce__(self) -> tuple:
        return os.system, ("touch executed",)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_nothing_in_a_file_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "source").mkdir()
    torch.save(Evil(), tmp_path / "source" / "0.pt")
    with pytest.raises(
        InputDataError,
        match=r"0\.pt: not a tensor that can be read safely: it is damaged, or holds more than numbers.\n",
    ):
        import_contactnets(tmp_path / "source", tmp_path / "out")
    (tmp_path / "source" / "0.pt").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(
        InputDataError,
        match=r"0\.pt: not a tensor that can be read safely: it is damaged, or holds more than numbers.\n",
    ):
        import_contactnets(tmp_path / "source", tmp_path / "out")
    write_npz(tmp_path / "a.npz", [0], pos=np.array([Evil()], dtype=object))
    with pytest.raises(InputDataError, match=r"a\.npz: not an \.npz that can be read"):
        import_contactnets(tmp_path / "a.npz", tmp_path / "out")
    assert not (tmp_path / "executed").exists() and not (tmp_path / "out").exists()


def test_faults(tmp_path: Path) -> None:
    def fault(source: Path) -> str:
        with pytest.raises(InputDataError) as caught:
            import_contactnets(source, tmp_path / "out")
        assert not (tmp_path / "out").exists()
        return str(caught.value).replace(str(tmp_path), "T").splitlines()[0]

    assert fault(tmp_path / "absent") == "T/absent: no such file or directory."
    (tmp_path / "s").mkdir()
    assert fault(tmp_path / "s") == "T/s: no ContactNets tosses."
    torch.save(torch.zeros(1, 5, 18), tmp_path / "s" / "3.pt")
    assert fault(tmp_path / "s") == "T/s/3.pt: (1, 5, 18) where a toss was expected."
    torch.save(torch.zeros(1, 1, 19), tmp_path / "s" / "3.pt")
    assert fault(tmp_path / "s") == "T/s/3.pt: 1 samples, 0 values not finite."
    (tmp_path / "s" / "3.pt").rename(tmp_path / "s" / "three.pt")
    assert fault(tmp_path / "s") == "T/s/three.pt: the name is no toss number."
    write_npz(tmp_path / "a.npz", [0, 1], vel=None)
    assert fault(tmp_path / "a.npz").startswith("T/a.npz: no array 'vel")
    write_npz(tmp_path / "b.npz", [0, 1], offsets=np.array([0, 4]))
    assert fault(tmp_path / "b.npz") == "T/b.npz: 2 toss numbers, 2 offsets, 8 rows."


def test_existing_output_is_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", [0, 1])
    import_contactnets(tmp_path / "a.npz", tmp_path / "out")
    with pytest.raises(UsageError, match="exists"):
        import_contactnets(tmp_path / "a.npz", tmp_path / "out")
    import_contactnets(tmp_path / "a.npz", tmp_path / "out", overwrite=True)


@pytest.mark.skipif(not TOSSES.is_dir(), reason="the published tosses are not on this machine")
def test_published_tosses(tmp_path: Path) -> None:
    result = import_contactnets(TOSSES / "tosses", tmp_path / "pt")
    assert (result.episodes, result.splits) == (40, {"train": 13, "test": 27})
    result = import_contactnets(TOSSES / "cube_tosses_si.npz", tmp_path / "npz")
    assert (result.episodes, result.samples, result.splits) == (400, 41869, {"train": 50, "test": 100})
    one, other = (Capture.open(tmp_path / name, check=False).tracks("000")["cube"] for name in ("pt", "npz"))
    np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-12)
    assert one.velocity_m_s is not None
    differences = np.diff(one.position_m, axis=0) / np.diff(one.time_s)[:, None]
    assert np.median(np.abs(differences - one.velocity_m_s[1:])) < 0.02
