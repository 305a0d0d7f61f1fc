"""HDF5 files of strangers: no link out of the file is followed, and nothing is read that is declared but not stored."""

import os
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets import import_hdf5
from cgwm.datasets.io.hdf5_files import own_objects, require_stored
from cgwm.datasets.rollouts import RolloutReader
from cgwm.schemas import ROLLOUTS_FORMAT, InputDataError

HUGE = 10**12


def poses(group: h5py.Group, count: int = 5) -> None:
    group["time"] = np.arange(count) / 100
    group["position"] = np.random.default_rng(0).normal(size=(count, 3))
    group["quat_wxyz"] = np.tile([1.0, 0, 0, 0], (count, 1))


def replaced(name: str, value: object) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        del group[name]
        group[name] = value

    return change


def declared(name: str, shape: tuple[int, ...], **options: object) -> Callable[[h5py.Group], None]:
    """An array of which nothing is written."""

    def change(group: h5py.Group) -> None:
        del group[name]
        group.create_dataset(name, shape, "f8", **options)  # pyright: ignore[reportArgumentType]

    return change


def virtual(group: h5py.Group) -> None:
    layout = h5py.VirtualLayout((5, 3), "f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "a", (5, 3))
    del group["position"]
    group.create_virtual_dataset("position", layout)


def outside(group: h5py.Group) -> None:
    del group["time"]
    group.create_dataset("time", (5,), "f8", external=[("/etc/hostname", 0, 40)])


def circle(group: h5py.Group) -> None:
    group["a"], group["b"] = h5py.SoftLink(f"{group.name}/b"), h5py.SoftLink(f"{group.name}/a")


REFUSED = {
    "dangling external link": (replaced("time", h5py.ExternalLink("gone.h5", "/time")), "a link to another file"),
    "external link to a pipe": (replaced("time", h5py.ExternalLink("pipe", "/t")), "a link to another file"),
    "dangling soft link": (replaced("quat_wxyz", h5py.SoftLink("/nowhere")), "leads nowhere or in circles"),
    "soft links in circles": (circle, "leads nowhere or in circles"),
    "virtual array elsewhere": (virtual, "looks into another file, /etc/hostname"),
    "external storage": (outside, "lie in another file, /etc/hostname"),
    "fewer positions": (replaced("position", np.zeros((4, 3))), "5 times, 4 positions, 5 orientations"),
    "fewer orientations": (replaced("quat_wxyz", np.zeros((4, 4))), "5 times, 5 positions, 4 orientations"),
    "strings": (replaced("time", ["0", "1"]), "the type object"),
    "compound": (replaced("time", np.zeros(5, [("a", "f8"), ("b", "f8")])), "has the shape (5,) and the type"),
    "no shape": (replaced("time", h5py.Empty("f8")), "has the shape None"),
    "a scalar": (replaced("time", 1.0), "has the shape ()"),
    "rows that are not there": (declared("time", (HUGE,), chunks=(1000,), compression="gzip"), f"declares {HUGE} rows"),
    "rows never written": (declared("time", (1000,), chunks=(10,)), "of which 0 bytes are stored"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_an_import_would_pass_over_or_never_finish_is_refused(name: str, tmp_path: Path) -> None:
    change, found = REFUSED[name]
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(tmp_path / "poses.h5", "w") as file:
        poses(file.create_group("first"))
        poses(file.create_group("second"))
        change(file["second"])  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputDataError) as refused:
        import_hdf5(tmp_path / "poses.h5", tmp_path / "out")
    assert found in str(refused.value) and str(tmp_path / "poses.h5") in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_groups_that_contain_themselves_are_one_episode(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "poses.h5", "w") as file:
        poses(file.create_group("first"))
        file["first/again"] = file["first"]
        file["alias"] = h5py.SoftLink("/first")
    assert import_hdf5(tmp_path / "poses.h5", tmp_path / "out").episodes == 1


@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_file_is_refused_or_read(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "poses.h5"
    with h5py.File(path, "w") as file:
        poses(file.create_group("first"))
    whole, rng = path.read_bytes(), np.random.default_rng(seed)
    for trial in range(20):
        data = bytearray(whole)
        for place in rng.integers(len(data), size=4):
            data[place] = rng.integers(256)
        path.write_bytes(data[: len(data) if trial % 3 else int(rng.integers(len(data)))])
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                import_hdf5(path, tmp_path / f"out{trial}")
        except InputDataError as error:
            assert str(path) in str(error)


def test_groups_in_groups_end(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        file.create_group("/".join("g" * 200))
        with pytest.raises(InputDataError, match="groups without end"):
            list(own_objects(file, "deep.h5"))


def test_an_array_that_is_stored_in_part_is_refused_where_it_is_large(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        small = file.create_dataset("small", (100,), "f8", chunks=(10,))
        large = file.create_dataset("large", (100_000_000,), "f8", chunks=(1000,))
        small[:10] = large[:10] = 1.0
        require_stored(small, "small")
        with pytest.raises(InputDataError, match="large: declares float64 "):
            require_stored(large, "large")
        covered = h5py.VirtualLayout((HUGE,), "f8")
        covered[:100] = h5py.VirtualSource(small)
        with pytest.raises(InputDataError, match="of which 100 numbers have a source"):
            require_stored(file.create_virtual_dataset("view", covered), "view")


def shard(path: Path, change: Callable[[h5py.File], None] = lambda file: None) -> Path:
    """A shard with one rollout of two frames, seen by a camera of 4x3 pixels."""
    with h5py.File(path, "w") as file:
        file.attrs["format"] = ROLLOUTS_FORMAT
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"], demo.attrs["episode_index"] = 2, 0
        demo["time"] = np.arange(2.0)
        demo["obs/cam_image"] = np.ones((2, 3, 4, 3), np.uint8)
        demo["cameras/cam/width"], demo["cameras/cam/height"] = 4, 3
        change(file)
    return path


def put(name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = value

    return change


def unwritten(file: h5py.File) -> None:
    del file["data/demo_0/obs/cam_image"]
    file.create_dataset("data/demo_0/obs/cam_image", (HUGE, 3, 4, 3), "u1", chunks=(8, 3, 4, 3), compression="gzip")


def index_of_anything(file: h5py.File) -> None:
    file["shards/file"], file["shards/bytes"] = np.array([b"/etc/hostname"]), np.array([7])


def uncovered_next(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((HUGE,), "f8")
    layout[:2] = h5py.VirtualSource(".", "data/demo_0/time", (2,))
    file["data/demo_0"].create_virtual_dataset("next", layout)  # pyright: ignore[reportAttributeAccessIssue]


STRANGE_SHARDS = {
    "arrays of zeros": (unwritten, "of which 0 bytes are stored"),
    "a virtual array of nothing": (uncovered_next, "of which 2 numbers have a source"),
    "a link to another file": (put("data/demo_0/time", h5py.ExternalLink("pipe", "/t")), "a link to another file"),
    "a rollout elsewhere": (put("data/demo_1", h5py.ExternalLink("pipe", "/t")), "a link to another file"),
    "data elsewhere": (put("data", h5py.ExternalLink("pipe", "/t")), "a link to another file"),
    "no rollout": (put("data/other", 1), "no rollout"),
    "images of another size": (put("data/demo_0/obs/cam_image", np.ones((2, 5, 5, 3))), "its shape is (2, 5, 5, 3)"),
    "an index of anything": (index_of_anything, "an index that looks into '/etc/hostname'"),
    "frames without end": (lambda f: f["data/demo_0"].attrs.modify("num_samples", HUGE), f"num_samples is {HUGE}"),
    "no number of frames": (lambda f: f["data/demo_0"].attrs.pop("num_samples"), "not a readable HDF5 file"),
}


@pytest.mark.parametrize("name", STRANGE_SHARDS)
def test_strange_shards_are_refused_before_they_are_read(name: str, tmp_path: Path) -> None:
    change, found = STRANGE_SHARDS[name]
    os.mkfifo(tmp_path / "pipe")
    path = shard(tmp_path / "rollouts-0000-of-0001.h5", change)
    with pytest.raises(InputDataError) as refused:
        RolloutReader(path).read(0, "time")
    assert found in str(refused.value) and str(path) in str(refused.value)


def test_the_plain_shard_is_read(tmp_path: Path) -> None:
    reader = RolloutReader(shard(tmp_path / "rollouts-0000-of-0001.h5"))
    np.testing.assert_array_equal(reader.read(0, "time"), [0.0, 1.0])
