"""Intrinsics of a camera from photos of the calibration target, by Zhang's method (2000) as OpenCV has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ....datasets.capture.exif import photo_lens
from ....datasets.capture.files import entries_of
from ....datasets.capture.images import IMAGE_SUFFIXES, read_rgb, unread_kinds
from ....datasets.io.atomic import new_file
from ....datasets.io.outputs import reads
from ....datasets.io.progress import progress
from ....schemas import CameraIntrinsics, InputDataError, NotConvergedError
from ....schemas.intrinsics import IntrinsicsFile, TargetPhoto
from ....schemas.printable import typed_path
from ..reconstruction import Array
from .board import charuco_board

INTRINSICS_NAME = "intrinsics.json"
MIN_PHOTOS, MIN_CORNERS = 8, 12
"""Fewest photos of the board, and fewest corners in each."""
_ODD, _LEAST_PX = 3.0, 0.3
"""A photo whose errors are this many times the median's, and larger than this [px], is not used: the board was bent,
or the photo blurred."""
_UNCERTAIN, _COVERED = 0.005, 0.6
"""Relative standard deviation of a focal length, and share of the picture that corners reach, that give a warning."""
_LENS = cv2.CALIB_FIX_K3
_CELLS = 8


@dataclass(frozen=True)
class _Seen:
    """The corners of the board in one photo."""

    name: str
    board_mm: Array
    """On the board, shape (n, 3)."""
    pixels: Array
    """In the photo, in OpenCV's pixels, whose first centre is (0, 0), shape (n, 2)."""


@dataclass(frozen=True)
class _Fit:
    K: Array
    lens: Array
    stds: Array
    rms: dict[str, float]


@reads("folder")
def calibrate_target(folder: Path | str, overwrite: bool = False) -> IntrinsicsFile:
    """Estimate the intrinsics of a camera from photos of the board, and write `intrinsics.json` beside them.

    Args:
        folder: Photos of the board, .jpg or .png, of one camera at one focal length.
        overwrite: Replace intrinsics that were written before. Otherwise those are kept that the same photos gave.

    Returns:
        The intrinsics, with standard deviations and the errors of photos that were held out.

    Raises:
        InputDataError: If the photos are of several sizes or lenses, or too few of them show the board.
        NotConvergedError: If no intrinsics explain them.
        UsageError: If other intrinsics are there, and `overwrite` is not set.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputDataError(
            f"{folder}: {'is a file' if folder.is_file() else 'no such folder'}.",
            "a folder of photos of the board, or a name .pdf or .svg for a new board.",
            "check the path, or print a board with 'cgwm calibrate board.pdf --target charuco'.",
        )
    path = folder / INTRINSICS_NAME
    if path.is_file() and not overwrite:
        file = _measured(folder)
        if path.read_bytes() == _text(file).encode():
            return file
    with new_file(path, "intrinsics", overwrite) as temporary:
        file = _measured(folder)
        temporary.write_text(_text(file), encoding="utf-8")
    return file


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Have OpenCV work in the calling thread alone, and afterwards in as many as before."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _text(file: IntrinsicsFile) -> str:
    return file.model_dump_json(indent=1) + "\n"


def _measured(folder: Path) -> IntrinsicsFile:
    entries = entries_of(folder)
    names = [path.name for path in entries if path.suffix.lower() in IMAGE_SUFFIXES]
    if len(names) < MIN_PHOTOS:
        unread = unread_kinds(entries)
        raise InputDataError(
            f"{folder}: {len(names)} photo(s)" + (f", and files {', '.join(unread)}." if unread else "."),
            f"at least {MIN_PHOTOS} photos of the board, .jpg or .png.",
            f"convert them: cgwm import photos {typed_path(folder)} --out BOARD; then their folder is BOARD/images."
            if unread
            else "print a board with 'cgwm calibrate board.pdf --target charuco', and photograph it from all sides.",
        )
    seen, size, lens = _corners(folder, names)
    used = {one.name: one for one in seen if len(one.pixels) >= MIN_CORNERS}
    _require_enough(folder, names, used)
    first = _fitted(list(used.values()), size)
    limit = max(_ODD * float(np.median(list(first.rms.values()))), _LEAST_PX)
    kept = {name: one for name, one in used.items() if first.rms[name] <= limit}
    _require_enough(folder, names, kept)
    fit = _fitted(list(kept.values()), size)
    photos = {one.name: _verdict(one, fit, first, one.name in kept) for one in seen}
    return _file(fit, size, photos, list(kept.values()), lens)


def _corners(folder: Path, names: Sequence[str]) -> tuple[list[_Seen], tuple[int, int], str]:
    """Return the corners in each photo, and the size and lens that all photos have."""
    detector = cv2.aruco.CharucoDetector(charuco_board())
    seen, sizes, lenses = [], {}, {}
    for name in progress(names, "board", unit="photo"):
        image = read_rgb(folder / name)
        sizes.setdefault(image.shape[1::-1], name)
        lenses.setdefault(photo_lens(folder / name), name)
        corners, identifiers, _, _ = detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        found = [] if identifiers is None else np.ravel(identifiers)
        board = np.asarray(charuco_board().getChessboardCorners(), float)[np.asarray(found, int)]
        pixels = np.zeros((0, 2)) if corners is None else np.asarray(corners, float).reshape(-1, 2)
        seen.append(_Seen(name, board, pixels))
    lenses = {text: name for text, name in lenses.items() if text}
    for what, different in (("size", {f"{w}x{h}": name for (w, h), name in sizes.items()}), ("lens", lenses)):
        if len(different) > 1:
            listed = ", ".join(f"{name} ({value})" for value, name in different.items())
            raise InputDataError(
                f"{folder}: photos of more than one {what}: {listed}.",
                "photos of one camera, all upright or all on the side, at one focal length.",
                "move the others to another folder, and calibrate it on its own.",
            )
    return seen, next(iter(sizes)), next(iter(lenses), "")


def _require_enough(folder: Path, names: Sequence[str], used: dict[str, _Seen]) -> None:
    if len(used) < MIN_PHOTOS:
        raise InputDataError(
            f"{folder}: {len(used)} of {len(names)} photos show {MIN_CORNERS} corners of the board or more.",
            f"at least {MIN_PHOTOS} photos that do, and that agree with each other.",
            "lay the print flat on something stiff, fill the picture with it, and tilt it by 30 to 45 degrees to all "
            "sides; without blur and glare.",
        )


def _fitted(seen: Sequence[_Seen], size: tuple[int, int]) -> _Fit:
    """Return K, k1, k2, p1, p2 and their standard deviations; cv2's bundle adjustment of all poses of the board."""
    boards = [one.board_mm.astype(np.float32) for one in seen]
    pixels = [one.pixels.astype(np.float32)[:, None] for one in seen]
    K, lens = np.eye(3), np.zeros(5)
    try:
        with one_opencv_thread():  # sums of several differ in the last digits from run to run
            _, K, lens, _, _, stds, _, errors = cv2.calibrateCameraExtended(boards, pixels, size, K, lens, flags=_LENS)
    except cv2.error as error:
        raise _no_camera(str(error.err)) from None
    values = np.concatenate([np.ravel(K), np.ravel(lens)[:4], np.ravel(stds)[:8]])
    if not np.isfinite(values).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise _no_camera("the fit diverged")
    rms = {one.name: float(error) for one, error in zip(seen, np.ravel(errors), strict=True)}
    return _Fit(np.asarray(K, float), np.ravel(lens)[:4].astype(float), np.ravel(stds)[:8].astype(float), rms)


def _no_camera(reason: str) -> NotConvergedError:
    return NotConvergedError(
        f"No intrinsics explain the photos of the board: {reason}.",
        "photos of one flat board, tilted to all sides.",
        "photograph it again; a board that always faces the camera determines no focal length.",
    )


def _verdict(one: _Seen, fit: _Fit, first: _Fit, kept: bool) -> TargetPhoto:
    if kept:
        return TargetPhoto(corners=len(one.pixels), rms_px=round(fit.rms[one.name], 4))
    if one.name in first.rms:
        reason = f"errors of {first.rms[one.name]:.1f} px, where the median photo has "
        return TargetPhoto(corners=len(one.pixels), reason=reason + f"{np.median(list(first.rms.values())):.1f} px")
    return TargetPhoto(
        corners=len(one.pixels), reason=f"{len(one.pixels)} corners of the board; at least {MIN_CORNERS}"
    )


def _file(
    fit: _Fit, size: tuple[int, int], photos: dict[str, TargetPhoto], seen: Sequence[_Seen], lens: str
) -> IntrinsicsFile:
    K, stds, covered = fit.K, [round(float(value), 8) for value in fit.stds], _covered(seen, size)
    squares = [(fit.rms[one.name] ** 2, len(one.pixels)) for one in seen]
    warnings = []
    if max(stds[0] / K[0, 0], stds[1] / K[1, 1]) > _UNCERTAIN:
        warnings.append(
            f"the focal length is uncertain by more than {100 * _UNCERTAIN:g} %: more photos, with the board tilted by "
            "30 to 45 degrees to all sides, determine it"
        )
    if covered < _COVERED:
        warnings.append(
            f"the corners of the board reach {100 * covered:.0f} % of the picture: the lens is extrapolated elsewhere; "
            "photograph the board in all corners of the picture"
        )
    return IntrinsicsFile(
        camera=CameraIntrinsics.of_lens(
            INTRINSICS_NAME, width=size[0], height=size[1], fx=K[0, 0], fy=K[1, 1],
            cx=K[0, 2] + 0.5, cy=K[1, 2] + 0.5,  # OpenCV has the first pixel's centre at 0
            distortion=[float(value) for value in fit.lens],
        ),
        fx_std_px=stds[0], fy_std_px=stds[1], cx_std_px=stds[2], cy_std_px=stds[3],
        distortion_std=(stds[4], stds[5], stds[6], stds[7]),
        rms_px=round(_rms(squares), 4), held_out_rms_px=round(_held_out(seen, size), 4), covered=round(covered, 3),
        lens=lens, photos=photos, warnings=tuple(warnings), versions={"opencv": cv2.__version__},
    )  # fmt: skip


def _rms(squares: Sequence[tuple[float, int]]) -> float:
    return float(np.sqrt(sum(value * count for value, count in squares) / sum(count for _, count in squares)))


def _held_out(seen: Sequence[_Seen], size: tuple[int, int]) -> float:
    """Return the reprojection error of each half of the photos under the intrinsics of the other half [px].

    A photo's pose of the board is estimated from its own corners: 6 numbers of some 50 corners.
    """
    squares = []
    for half in (0, 1):
        fit = _fitted([one for k, one in enumerate(seen) if k % 2 != half], size)
        for one in seen[half::2]:
            _, turn, shift = cv2.solvePnP(one.board_mm, one.pixels, fit.K, fit.lens)
            drawn = cv2.projectPoints(one.board_mm, turn, shift, fit.K, fit.lens)[0][:, 0]
            squares.append((float(np.square(drawn - one.pixels).sum(1).mean()), len(one.pixels)))
    return _rms(squares)


def _covered(seen: Sequence[_Seen], size: tuple[int, int]) -> float:
    """Return the share of the cells of an 8 x 8 grid over the picture in which a corner was seen."""
    pixels = np.concatenate([one.pixels for one in seen])
    cells = np.clip(_CELLS * (pixels + 0.5) / size, 0, _CELLS - 1).astype(int)
    return len({(int(x), int(y)) for x, y in cells}) / _CELLS**2
