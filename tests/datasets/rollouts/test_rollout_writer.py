"""The writer: chunks equal those of HDF5's own filters, errors reach the caller, memory is bounded, JPEG comes back."""

import errno
import subprocess
import sys
import threading
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.rollouts import guarded_file, rollout_demo, rollout_writer
from cgwm.datasets.rollouts.chunks import chunked, encoded, image_of, jpeg_of
from cgwm.datasets.rollouts.guarded_file import written_hdf5
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.datasets.rollouts.rollout_writer import RolloutWriter
from cgwm.datasets.rollouts.rollouts import amodal_dtype
from cgwm.schemas import InputDataError, NotEnoughSpaceError
from datasets.rollouts.test_rollouts import FRAMES, SIZE, blocks, labels


@pytest.mark.parametrize("compression", ["zstd", "gzip", "none"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_chunks_are_those_of_the_filters(tmp_path: Path, compression: str, dtype: type) -> None:
    frames = np.random.default_rng(0).integers(0, 9, (11, 12, 16)).astype(dtype)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        options = {"zstd": hdf5plugin.Zstd(clevel=1), "gzip": {"compression": "gzip"}, "none": {}}[compression]
        shuffle = compression != "none" and np.dtype(dtype).itemsize > 1
        theirs = file.create_dataset("theirs", data=frames, chunks=(8, 12, 16), shuffle=shuffle, **options)
        properties = chunked(compression, np.dtype(dtype), (8, 12, 16))
        space = h5py.h5s.create_simple(frames.shape)
        ours = h5py.h5d.create(file.id, b"ours", h5py.h5t.py_create(np.dtype(dtype)), space, properties)
        for start in (0, 8):
            chunk = encoded(frames[start : start + 8], compression, 8)
            ours.write_direct_chunk((start, 0, 0), chunk)
            assert bytes(chunk) == theirs.id.read_direct_chunk((start, 0, 0))[1]
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["ours"][()], frames)


def test_the_threads_change_no_byte(tmp_path: Path) -> None:
    hashes = set()
    for threads in (1, 7):
        path = tmp_path / f"{threads}.h5"
        with RolloutWriter(path, 3, "{}", "test", threads=threads) as writer:
            for index in range(4):
                writer.write(labels(index), blocks(index))
        hashes.add(sha256(path))
    assert len(hashes) == 1


def test_jpeg_is_small_and_near(tmp_path: Path) -> None:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    smooth = np.stack([rows * 5, columns * 4, rows + columns], -1).astype(np.uint8)
    assert np.abs(image_of(jpeg_of(smooth)).astype(int) - smooth).mean() < 3
    with RolloutWriter(tmp_path / "a.h5", 3, "{}", "test", "jpeg") as writer:
        writer.write(labels(2), blocks(2))
    reader = RolloutReader(tmp_path / "a.h5")
    stored = reader.group(0)["obs/left_image"]
    assert stored.shape[0] == FRAMES and stored.ndim == 2 and stored.attrs["encoding"] == "jpeg"
    assert (stored.attrs["height"], stored.attrs["width"]) == SIZE
    images = reader.read(0, "obs/left_image", 2, 5)
    written = np.concatenate([block.image for block in blocks(2)])
    assert images.shape == (3, *SIZE, 3) and images.dtype == np.uint8
    for number, image in enumerate(images):  # noise is what JPEG is worst at; another frame is far off
        errors = [np.abs(image.astype(int) - other).mean() for other in written]
        assert int(np.argmin(errors)) == number + 2
    np.testing.assert_array_equal(reader.read(0, "obs/left_depth"), np.concatenate([b.depth for b in blocks(2)]))
    reader.close()
    with pytest.raises(InputDataError, match="is no JPEG"):
        image_of(np.zeros(20, np.uint8))


def test_a_full_disk_is_one_clear_message(tmp_path: Path) -> None:
    """The limit of the size of files is the only full disk that a test can make without being root."""
    program = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from pathlib import Path
from cgwm.datasets.rollouts.rollout_writer import RolloutWriter
from cgwm.schemas import NotEnoughSpaceError
from datasets.rollouts.test_rollouts import blocks, labels
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
try:
    with RolloutWriter(Path({str(tmp_path)!r}) / "a.h5", 3, "{{}}", "test") as writer:
        for index in range(1000):
            writer.write(labels(index), blocks(index))
except NotEnoughSpaceError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    first, todo = done.stdout.splitlines()
    assert f"{tmp_path}: after " in first and "full: File too large." in first
    assert todo.startswith("Next: free some")


def test_an_hdf5_file_that_does_not_fit_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a file that h5py opens by its name, this process would crash at its exit."""

    def full(descriptor: int, data: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(guarded_file.os, "write", full)
    with pytest.raises(OSError, match="No space left"), written_hdf5(tmp_path / "a.h5") as file:
        file.create_dataset("x", data=np.zeros(100_000))
    assert not file.id.valid


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_what_fails_in_the_thread_is_raised_in_the_caller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(number, "broken")

    monkeypatch.setattr(rollout_demo, "write_tables", fail)
    with pytest.raises(NotEnoughSpaceError if number == errno.ENOSPC else OSError):
        with RolloutWriter(tmp_path / "a.h5", 3, "{}", "test") as writer:
            for index in range(2000):  # more than may wait
                writer.write(labels(index), blocks(index))


def test_no_more_waits_than_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for one block, the second is not rendered before the first is in the file."""
    size = sum(image.nbytes for image in blocks(0)[0].images.values())
    monkeypatch.setattr(rollout_writer, "MOST_WAITING_BYTES", size)
    go_on, asked = threading.Event(), []
    encode = rollout_writer._encoded_images

    def slowly(*arguments: object) -> object:
        assert go_on.wait(20)
        return encode(*arguments)

    def frames(index: int) -> object:
        for number, block in enumerate(blocks(index)):
            asked.append((index, number))
            if (index, number) == (0, 1):
                threading.Timer(0.3, go_on.set).start()
            if (index, number) == (1, 0):
                assert go_on.is_set()
            yield block

    monkeypatch.setattr(rollout_writer, "_encoded_images", slowly)
    with RolloutWriter(tmp_path / "a.h5", 3, "{}", "test") as writer:
        for index in range(2):
            writer.write(labels(index), frames(index))
    assert asked == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_amodal_masks_have_a_bit_for_each_body() -> None:
    assert [amodal_dtype(count) for count in (1, 8, 9, 33, 64)] == [np.uint8, np.uint8, np.uint16, np.uint64, np.uint64]
    with pytest.raises(InputDataError, match="65 bodies"):
        amodal_dtype(65)


def test_a_missing_package_is_named_before_there_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("compression.zstd", "backports.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputDataError, match=r"backports.zstd.*\n.*=gzip or none.*\n.*pip install backports"):
        RolloutWriter(tmp_path / "a.h5", 3, "{}", "test")
    assert not (tmp_path / "a.h5").exists()
    with RolloutWriter(tmp_path / "b.h5", 3, "{}", "test", "gzip") as writer:
        writer.write(labels(0), blocks(0))
