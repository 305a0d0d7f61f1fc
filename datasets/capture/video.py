"""Reading and writing of videos: a directory of numbered frames, or an mp4, mov or webm file."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import require_regular_file
from ..io.atomic import temporary_directory
from .files import entries_of
from .images import IMAGE_SUFFIXES, image_size, read_label, read_rgb

VIDEO_SUFFIXES = (".mp4", ".mov", ".webm")
"""Suffixes of readable video files."""
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video from its headers."""

    frames: int
    """Number of frames."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    frame_rate_hz: float | None = None
    """Frame rate of the file [Hz]; None for a directory of frames."""


def frame_files(folder: Path) -> list[Path]:
    """Return the frames of a directory, frame 0 first.

    Raises:
        InputDataError: If a name is not a number, or a number is missing, which would shift the times of later frames.
    """
    numbered = _numbered([path for path in entries_of(folder) if path.suffix.lower() in IMAGE_SUFFIXES])
    missing = next((k for k in range(len(numbered)) if k not in numbered), None)
    if missing is not None:
        raise InputDataError(
            f"{folder}: frame {missing} is missing ({len(numbered)} frames, the last is {max(numbered)}).",
            "frames numbered 0, 1, 2, ... without gaps, since the number is the time.",
            "number the frames from 0.",
        )
    return [numbered[k] for k in range(len(numbered))]


def _numbered(files: Sequence[Path]) -> dict[int, Path]:
    """Return files by the numbers that are their names."""
    numbered: dict[int, Path] = {}
    for file in files:
        if not (file.stem.isascii() and file.stem.isdecimal()):
            raise InputDataError(
                f"{file}: the name is no frame number.",
                "000000.png, 000001.png, ...",
                "name frames by their numbers, such as 000012.png.",
            )
        number = int(file.stem)
        if number in numbered:
            raise InputDataError(
                f"{file}: frame {number} is there twice, also as {numbered[number].name}.",
                todo="remove one of the two.",
            )
        numbered[number] = file
    return numbered


def video_info(path: Path, decode: bool = False) -> VideoInfo:
    """Return the number and size of the frames; in a directory, the header of each frame is checked.

    Args:
        path: A directory of frames or a video file.
        decode: Count the frames of a video file by decoding it instead of reading its header.

    Raises:
        InputDataError: If it does not decode, has no frame, or its frames differ in size.
    """
    if path.is_dir():
        return _folder_info(path)
    capture = _open(path)
    try:
        frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        readable = capture.grab()
    finally:
        capture.release()
    if not readable:
        raise _undecodable(path)
    # A webm that was streamed carries no frame count in its header; no header is believed that counts more frames than
    # there are bytes.
    if decode or not 0 < frames <= path.stat().st_size:
        frames = _count(path)
    return VideoInfo(frames, width, height, rate if rate > 0 else None)


def read_video(path: Path) -> NDArray[np.uint8]:
    """Return all frames as RGB, uint8, shape (frames, height, width, 3)."""
    if path.is_dir():
        _folder_info(path)
        return np.stack([read_rgb(file) for file in frame_files(path)])
    frames = [np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8) for frame in _grab(path)]
    if not frames:
        raise _undecodable(path)
    return np.stack(frames)


def read_video_labels(folder: Path) -> NDArray[np.uint8]:
    """Return the label images of a directory of frames, uint8, shape (frames, height, width)."""
    return np.stack([read_label(file) for file in frame_files(folder)])


def _folder_info(folder: Path) -> VideoInfo:
    files = frame_files(folder)
    if not files:
        raise InputDataError(
            f"{folder}: no frames.",
            "000000.png, 000001.png, ... or .jpg.",
            "put the frames of the video into it, named by their numbers.",
        )
    width, height = image_size(files[0])
    for file in files[1:]:
        size = image_size(file)
        if size != (width, height):
            raise InputDataError(
                f"{file}: {size[0]}x{size[1]} px, but {files[0].name} has {width}x{height} px.",
                "frames of one size.",
                "make all frames of a video of one size.",
            )
    return VideoInfo(len(files), width, height)


def encoded_video(frames: Sequence[NDArray[np.uint8]], frame_rate_hz: float) -> bytes:
    """Encode RGB frames, each (height, width, 3) with even sides, as an MP4 file.

    The codec is VP9, which browsers play, if this OpenCV has it; otherwise MPEG-4 part 2, which players play.
    """
    return _encoded(frames, frame_rate_hz, ".mp4", ("vp09", "mp4v"))


def encoded_webm(frames: Sequence[NDArray[np.uint8]], frame_rate_hz: float) -> bytes:
    """Encode RGB frames, each (height, width, 3) with even sides, as a WebM file, which browsers play.

    The codec is VP8, which OpenCV writes five times faster than VP9, with files a third larger.

    Raises:
        InputDataError: If this OpenCV writes neither.
    """
    return _encoded(frames, frame_rate_hz, ".webm", ("VP80", "VP90"))


def _encoded(frames: Sequence[NDArray[np.uint8]], frame_rate_hz: float, suffix: str, codecs: Sequence[str]) -> bytes:
    height, width = frames[0].shape[:2]
    with temporary_directory("film", "a film") as folder:
        path = folder / f"film{suffix}"
        for codec in codecs:
            with _quiet():
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), frame_rate_hz, (width, height))
            if writer.isOpened():
                break
        else:
            raise InputDataError(
                f"this OpenCV ({cv2.__version__}) writes no {suffix} video.", todo="pip install opencv-python-headless"
            )
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        writer.release()
        if _count(path) < len(frames):  # OpenCV's writer reports no error
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return path.read_bytes()


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the message of OpenCV's writer about the tag of a codec, which ignores log levels."""
    sys.stderr.flush()
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def _open(path: Path) -> cv2.VideoCapture:
    with require_regular_file(path).open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    # A text may be a playlist, through which the decoder would open other files.
    if b"\0" not in head:
        raise _undecodable(path)
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise _undecodable(path)
    return capture


def frames_of(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a video file one after the other, BGR (height, width, 3), upright as its rotation says.

    Raises:
        InputDataError: If it does not decode, or has no frame.
    """
    decoded = False
    for frame in _grab(path):
        decoded = True
        yield frame
    if not decoded:
        raise _undecodable(path)


def _grab(path: Path) -> Iterator[NDArray[np.uint8]]:
    capture = _open(path)
    try:
        while True:
            done, frame = capture.read()
            if not done:
                return
            yield np.asarray(frame, np.uint8)
    finally:
        capture.release()


def _count(path: Path) -> int:
    capture = _open(path)
    try:
        count = 0
        while capture.grab():
            count += 1
        return count
    finally:
        capture.release()


def _undecodable(path: Path) -> InputDataError:
    return InputDataError(
        f"{path}: the video does not decode.",
        "mp4, mov or webm, or a directory of frames.",
        "copy it from the camera again, or convert it, for example: ffmpeg -i VIDEO -start_number 0 %06d.png",
    )
