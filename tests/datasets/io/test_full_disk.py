"""A full disk, and a name under which nothing can be written, end with one message and leave nothing."""

import errno
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import new_directory, new_file
from cgwm.datasets.capture import video
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.io.atomic import replaced_file, scratch_file, temporary_directory
from cgwm.datasets.io.free_space import full_disk
from cgwm.datasets.io.places import LONGEST_NAME, require_place
from cgwm.schemas import InputDataError, NotEnoughSpaceError, UsageError

FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    "error",
    [
        FULL,
        OSError(errno.EFBIG, "x"),
        sqlite3.OperationalError("database or disk is full"),
        OSError("12800 requested and 64 written"),
        RuntimeError("SQLite error: database or disk is full"),
    ],
    ids=str,
)
@pytest.mark.parametrize(
    "output",
    [lambda path: new_directory(path, "model"), lambda path: new_file(path, "index"), replaced_file, scratch_file],
    ids=["directory", "file", "replaced", "scratch"],
)
def test_a_full_disk_names_output_and_next_step(output: Callable, error: Exception, tmp_path: Path) -> None:
    with pytest.raises(NotEnoughSpaceError) as caught, output(tmp_path / "out"):
        raise error
    assert str(caught.value).startswith(f"{tmp_path / 'out'}: no room for ") and "Next: make room" in str(caught.value)
    assert caught.value.exit_code == 1 and not list(tmp_path.iterdir())


def test_a_full_disk_behind_another_error_is_seen_and_other_errors_are_not() -> None:
    try:
        try:
            raise FULL
        except OSError:
            raise RuntimeError("cannot close the file")  # noqa: B904  what a library does
    except RuntimeError as error:
        assert full_disk(error)
    assert full_disk(ValueError("x")) is None and full_disk(OSError(errno.EIO, "x")) is None
    assert full_disk(InputDataError("a file too large")) is None


def test_the_outermost_output_is_named_once(tmp_path: Path) -> None:
    with pytest.raises(NotEnoughSpaceError) as caught, new_directory(tmp_path / "out", "demo") as folder:
        with replaced_file(folder / "inside"):
            raise FULL
    assert str(caught.value).count("no room") == 1 and ".partial-" not in str(caught.value)


def test_what_the_disk_lost_after_it_was_written_is_not_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Network file systems report a full disk at the flush."""

    def full(descriptor: int) -> None:
        raise FULL

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(NotEnoughSpaceError), new_file(tmp_path / "out", "index") as temporary:
        temporary.write_text("x")
    assert not list(tmp_path.iterdir())


def test_a_film_of_which_frames_are_lost_is_no_film(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [np.full((48, 64, 3), k, np.uint8) for k in range(12)]
    assert video.encoded_video(frames, 10.0)
    monkeypatch.setattr(video, "_count", lambda path: 11)
    with pytest.raises(NotEnoughSpaceError, match=r"no room for a film(.|\n)*TMPDIR"):
        video.encoded_video(frames, 10.0)


def test_an_image_that_its_format_does_not_take_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"70000 x 2 px cannot be written as \.jpg"):
        write_image(tmp_path / "x.jpg", np.zeros((2, 70_000, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_a_temporary_folder_of_a_dead_process_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / ".cgwm-film.partial-999999999-11111111").mkdir()
    with temporary_directory("film", "a film") as folder:
        assert [path.name for path in tmp_path.iterdir()] == [folder.name]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a\nb", "control character"),
        ("a\0b", "control character"),
        ("\x1b[31m", "control character"),
        ("x" * (LONGEST_NAME + 1), "a name of 201 bytes"),
        ("\u00e9" * 130, "a name of 260 bytes"),
        ("x" * 300 + "/y", "a name of 300 bytes"),
        ("file/out", "is a file, and no folder"),
        ("file/deeper/out", "is a file, and no folder"),
        ("nowhere/out", "a link that leads nowhere"),
    ],
)
def test_a_name_under_which_nothing_can_be_written_is_refused_at_once(name: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "nowhere").symlink_to(tmp_path / "missing")
    for output in (lambda path: new_directory(path, "model"), lambda path: new_file(path, "index"), replaced_file):
        with pytest.raises(UsageError, match=said) as caught, output(tmp_path / name):
            raise AssertionError("not reached")
        assert "\x1b" not in str(caught.value) and caught.value.exit_code == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "nowhere"]


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(UsageError, match=f"the folder {tmp_path} cannot be written to"):
        require_place(tmp_path / "new" / "out")


def test_usual_names_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("out", "./a/b/c", "x" * LONGEST_NAME, "\u00fcber uns", tmp_path / "out", ".", "-"):
        require_place(name)
