"""What is no regular, readable file is refused before it is opened."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cgwm.schemas import InputDataError
from cgwm.schemas.regular_files import read_text_file, real_path, require_regular_file


def _broken_link(path: Path) -> None:
    path.symlink_to(path.with_name("absent"))


def _circle(path: Path) -> None:
    path.symlink_to(path)


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda path: None, "no such file"),
        (_broken_link, "which does not exist"),
        (_circle, "leads in circles"),
        (_device, "is a device"),
        (os.mkfifo, "is a named pipe"),
        (os.mkdir, "is a directory"),
    ],
)
def test_what_is_no_regular_file_is_refused(make, found: str, tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    make(path)
    with pytest.raises(InputDataError, match=found) as refused:
        require_regular_file(path)
    assert str(path) in str(refused.value)


def test_a_link_to_a_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("größe\n", encoding="utf-8")
    (tmp_path / "link.txt").symlink_to("real.txt")
    assert read_text_file(tmp_path / "link.txt") == "größe\n"


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(InputDataError, match="not a text file in UTF-8"):
        read_text_file(tmp_path / "a.json")


def test_the_real_path_of_a_link_to_itself_is_no_fault(tmp_path: Path) -> None:
    _circle(tmp_path / "circle")
    (tmp_path / "link").symlink_to(tmp_path)
    assert real_path(tmp_path / "circle") == tmp_path.resolve() / "circle"
    assert real_path(tmp_path / "link" / "file") == tmp_path.resolve() / "file"
