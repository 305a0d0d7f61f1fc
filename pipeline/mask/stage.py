"""The stage mask (`cgwm mask`): write masks of one body in photos, as calibrate and fit read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.capture import Capture
from ...datasets.capture.exif import turned_as_file, turned_upright, upright_size
from ...datasets.capture.files import entries_of
from ...datasets.capture.images import IMAGE_SUFFIXES, cut_out, image_size, read_rgb, unread_kinds, write_image
from ...datasets.io.atomic import new_directory
from ...datasets.io.kinds import kind_of
from ...datasets.io.outputs import reads
from ...datasets.io.progress import progress
from ...schemas import CaptureManifest, InputDataError, MasksReport, NotConvergedError, UsageError, read_toml
from ...schemas.masks import PhotoMask
from ...schemas.printable import typed_path
from ..foreground.graph_cut import Mask
from .body_masks import before_plain, from_box, on_turntable
from .doubts import doubts

MASKS_NAME = "masks.json"

_SIZE = 800
"""Maximum longer side of the reduced photos [px]; masks are resized to the size of the photos."""
_LEAST_FOUND = 0.5
"""Least share of the photos in which the body has to be found."""


@dataclass(frozen=True)
class _Photos:
    """Photos, and which body is masked in them."""

    folder: Path
    """Their folder."""
    names: list[str]
    """Their names relative to it, in order."""
    body: str
    """Name of the body, or empty."""
    label: int
    """Its label."""


@reads("source")
def mask(
    source: Path | str,
    out: Path | str,
    box: tuple[float, float, float, float] | None = None,
    photo: str | None = None,
    body: str | None = None,
    overwrite: bool = False,
) -> MasksReport:
    """Write masks of one body in photos: `<name>.png`, 0 behind the body, its label on it.

    Without a box the body is what is opaque in photos that another tool has cut out, what stands before a background of
    one colour, or what turns before surroundings that stand (a turntable). With one, it is what the box holds in one
    photo; the other photos are cut by its colours.

    Args:
        source: A capture, or a folder of photos.
        out: The directory to write; for a capture usually its `masks`.
        box: Left, upper, right and lower border of the body in `photo` [px], as viewers show it: turned upright as its
            EXIF data say.
        photo: Name of the photo that `box` is about; None takes the first.
        body: Name of the body in the capture; None takes the only one.
        overwrite: Replace `out`.

    Returns:
        What `masks.json` holds: how the body was found, and which masks should be looked at.

    Raises:
        InputDataError: If there are no photos, or no box is given and the photos do not tell the body.
        UsageError: If `out` exists, the box is outside of its photo, or there is no such photo or body.
        NotConvergedError: If the body is found in fewer than half of the photos.
    """
    with new_directory(out, "masks", overwrite) as directory:
        given = _photos(Path(source), body)
        reference = _reference(given, photo)
        if box is not None:
            _require_inside(given, reference, box)
        method, masks = "opacity", [] if box is not None else _opaque(given)
        if not masks:
            small = [_upright(given.folder / name) for name in progress(given.names, "photos", unit="photo")]
            method, masks = _masks(given, small, reference, box)
        report = masks_report(method, given.body, given.label, given.names, masks)
        for name, found in zip(given.names, masks, strict=True):
            width, height = image_size(given.folder / name)
            in_file = turned_as_file(given.folder / name, found)
            large = cv2.resize(in_file.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
            path = (directory / name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, np.where(large, given.label, 0).astype(np.uint8))
        (directory / MASKS_NAME).write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return report


def _photos(source: Path, body: str | None) -> _Photos:
    if kind_of(source) == "capture":
        capture = Capture(source, read_toml(source / "capture.toml", CaptureManifest))
        names = capture.photos()
        folder, bodies = source / "images", [one.name for one in capture.manifest.bodies]
    else:
        if not source.exists():
            raise InputDataError(f"{source}: no such folder.", "a folder of photos, or a capture.", "correct the path.")
        if source.is_file():
            raise InputDataError(
                f"{source}: is a file.",
                "a folder of photos, or a capture.",
                "name the folder that holds the photos (a video: cgwm import video).",
            )
        names = [entry.name for entry in entries_of(source) if entry.suffix.lower() in IMAGE_SUFFIXES]
        folder, bodies = source, []
    if not names:
        raise _no_photos(folder)
    if len({Path(name).with_suffix("") for name in names}) < len(names):
        raise InputDataError(
            f"{folder}: two photos whose names differ in the suffix alone.",
            "a name for each photo: its mask is <name>.png.",
            "rename one of them.",
        )
    return _Photos(folder, names, *body_of(source, bodies, body))


def _no_photos(folder: Path) -> InputDataError:
    """Return the error of a folder without photos that are read."""
    unread = unread_kinds(entries_of(folder))
    return InputDataError(
        f"{folder}: no photos" + (f", but files {', '.join(unread)}." if unread else "."),
        "photos .jpg, .jpeg or .png.",
        f"make a capture of them first: cgwm import photos {typed_path(folder)} --out CAPTURE."
        if unread
        else "name the folder that holds them.",
    )


def body_of(source: Path, bodies: Sequence[str], body: str | None) -> tuple[str, int]:
    """Return the body that is masked, empty without any, and its label.

    Raises:
        UsageError: If there is no such body, or there are several and none is named.
    """
    if body is not None and body not in bodies:
        listed = ", ".join(bodies) or "none: a folder of photos has no bodies"
        raise UsageError(f"--body {body}: no such body in {source}.", f"bodies: {listed}.", "name one of them.")
    if body is None and len(bodies) > 1:
        raise UsageError(
            f"{source} has {len(bodies)} bodies: {', '.join(bodies)}.", "one body in a run.", "--body NAME."
        )
    chosen = body or (bodies[0] if bodies else "")
    return chosen, bodies.index(chosen) + 1 if chosen else 1


def _reference(given: _Photos, photo: str | None) -> int:
    if photo is None:
        return 0
    if photo not in given.names:
        raise UsageError(
            f"--photo {photo}: no such photo in {given.folder}.", f"for example {given.names[0]}.", "name one of them."
        )
    return given.names.index(photo)


def _require_inside(given: _Photos, reference: int, box: tuple[float, float, float, float]) -> None:
    """Refuse a box that is not inside its photo, as viewers show it."""
    width, height = _shown_size(given, reference)
    left, upper, right, lower = box
    if not (0 <= left < right <= width and 0 <= upper < lower <= height):
        raise UsageError(
            f"--box {','.join(f'{value:g}' for value in box)}: not inside {given.names[reference]}, which has "
            f"{width} x {height} pixels.",
            "x0,y0,x1,y1 with x0 < x1 and y0 < y1: left, upper, right and lower border.",
            "read them off in an image viewer, with some pixels of the background all around the body.",
        )


def _shown_size(given: _Photos, photo: int) -> tuple[int, int]:
    path = given.folder / given.names[photo]
    return upright_size(path, image_size(path))


def _opaque(given: _Photos) -> list[Mask]:
    """Return where photos are opaque that were cut out by another tool; nothing where one was not."""
    masks = []
    for name in given.names:
        opaque = cut_out(given.folder / name) if name.lower().endswith(".png") else None
        if opaque is None:
            return []
        masks.append(turned_upright(given.folder / name, _reduced(255 * opaque.astype(np.uint8))) > 127)
    return masks


def _upright(path: Path) -> NDArray[np.uint8]:
    """Return a photo reduced, as viewers show it: neighbours are compared, whose files may be turned differently."""
    return turned_upright(path, _reduced(read_rgb(path)))


def _reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    scale = min(1.0, _SIZE / max(image.shape[:2]))
    if scale == 1.0:
        return image
    size = max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _masks(
    given: _Photos, small: list[NDArray[np.uint8]], reference: int, box: tuple[float, float, float, float] | None
) -> tuple[str, list[Mask]]:
    if box is not None:
        scale = small[reference].shape[1] / _shown_size(given, reference)[0]
        left, upper, right, lower = (scale * value for value in box)
        return "box", from_box(small, reference, (left, upper, right, lower))
    for method, found in (("plain", before_plain), ("turntable", on_turntable)):
        masks = found(small)
        if masks is not None:
            return method, masks
    raise InputDataError(
        f"{given.folder}: the photos do not tell the body: none stands before one colour, and none turns before "
        "surroundings that stand.",
        "photos before one colour, or of a turntable, or a box around the body in one photo.",
        f"--box x0,y0,x1,y1 [--photo NAME]: its borders in pixels, in {given.names[0]} unless --photo names another.",
    )


def masks_report(method: str, body: str, label: int, names: Sequence[str], masks: Sequence[Mask]) -> MasksReport:
    """Return the content of `masks.json`, given the names of the pictures and their masks.

    Raises:
        NotConvergedError: If the body is in fewer than half of them.
    """
    photos = {
        name: PhotoMask(share=round(float(found.mean()), 5), doubt=doubt)
        for name, found, doubt in zip(names, masks, doubts(masks), strict=True)
    }
    empty = sum(not found.any() for found in masks)
    if empty > (1 - _LEAST_FOUND) * len(masks):
        raise NotConvergedError(
            f"The body was found in {len(masks) - empty} of {len(masks)} pictures.",
            f"at least {_LEAST_FOUND:.0%} of them.",
            "give a --box that holds the whole body and little else, in a photo from the middle of the series, or film "
            "the empty place without the body.",
        )
    return MasksReport.model_validate(
        {
            "method": method,
            "body": body,
            "label": label,
            "photos": photos,
            "versions": {"opencv": cv2.__version__},
        }
    )
