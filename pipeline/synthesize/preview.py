"""Preview of a dataset: a contact sheet and a film of its first rollouts with their contacts.

Both are made from a finished shard through the public reader and stored next to it; no hash includes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.cameras import Camera
from ...datasets.capture.video import encoded_webm
from ...datasets.io.atomic import replaced_file
from ...datasets.rollouts.loader import RolloutReader
from ...schemas import CgwmError, DatasetSummary, InputDataError
from ..rendering.contact_glyphs import SLIDING_RGB, STICKING_RGB, ContactMarks, arrow_scale, contact_marks
from ..rendering.contact_sheets import Image, contact_sheet, encoded, evenly, resized

SHEET, FILM = "preview.png", "preview.webm"
ROLLOUTS = 4
"""Number of rollouts shown; with fewer in the shard, further cameras of them fill the space."""
MOMENTS = 5
SLOWER = 3.0
"""Slow-motion factor of the film."""
_TILE_WIDTH_PX = (320, 480)
"""Minimum and maximum width of a tile [px]; other pictures are resized."""
_LONGEST_ARROW = 0.4
"""Length of the arrow of the largest impulse, as a share of the height of a picture."""
_MOST_FILM_FRAMES = 240
_INK, _PAPER = (29, 33, 41), (255, 255, 255)
_STRIP_PX = 34
_FONT, _TEXT = cv2.FONT_HERSHEY_SIMPLEX, 0.48


@dataclass(frozen=True, kw_only=True)
class _Shot:
    """One rollout in one camera, T frames."""

    name: str
    """Title of the tile."""
    camera: Camera
    """Camera at the size of the tiles."""
    times_s: NDArray[np.float64]
    """Times of the frames [s], shape (T,)."""
    images: Image
    """Images as stored in the shard, shape (T, H, W, 3)."""
    marks: tuple[ContactMarks, ...]
    """Contacts to draw, by frame."""
    strength_n_s: NDArray[np.float64]
    """Sum of the magnitudes of the impulses of each frame [N s], shape (T,)."""

    def tile(self, frame: int) -> Image:
        """Return a frame with its contacts and its time, shape (height, width, 3) of the camera."""
        picture = resized(self.images[frame], (self.camera.width, self.camera.height))
        draw_contacts(picture, self.camera, self.marks[frame])
        _title(picture, f"{self.name}, {self.times_s[frame]:.2f} s")
        return picture


def with_preview(summary: DatasetSummary) -> DatasetSummary:
    """Write the preview of a new shard next to it, and return its summary with the names of the files.

    A dataset is complete without a preview: if it cannot be made, a note in the summary gives the reason.
    """
    folder = Path(summary.dataset)
    if summary.up_to_date and all((folder / name).is_file() for name in (SHEET, FILM)):
        return summary.model_copy(update={"preview": (SHEET, FILM)})
    if not summary.cameras:
        return _noted(summary, "no preview: the rollouts have no images")
    try:
        sheet, film = preview(folder / summary.shard)
        for name, content in ((SHEET, sheet), (FILM, film)):
            with replaced_file(folder / name) as temporary:
                temporary.write_bytes(content)
    except CgwmError as error:
        return _noted(summary, f"no preview: {error.found}")
    except OSError as error:
        return _noted(summary, f"no preview: {error.strerror or error}")
    return summary.model_copy(update={"preview": (SHEET, FILM)})


def preview(shard: Path) -> tuple[bytes, bytes]:
    """Return a contact sheet (PNG) and a film (WebM) of the first rollouts of a shard.

    Raises:
        InputDataError: If the shard cannot be read or has no images, or this OpenCV writes no WebM.
    """
    reader = RolloutReader(shard)
    try:
        shots, largest = _shots(reader)
    finally:
        reader.close()
    rows = [np.stack([shot.tile(frame) for frame in telling_frames(shot.strength_n_s, MOMENTS)]) for shot in shots]
    width = len(rows[0]) * (shots[0].camera.width + 4) - 4
    sheet = np.concatenate([contact_sheet(rows), _legend(width, largest, "")])
    return encoded(sheet, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 6]), _film(shots, largest)


def telling_frames(strength_n_s: NDArray[np.float64], wanted: int) -> list[int]:
    """Return up to `wanted` frames: the first, and in each later interval of equal length that with most impulse.

    >>> telling_frames(np.array([0.0, 0.0, 3.0, 0.0, 1.0, 2.0, 0.0]), 3)
    [0, 2, 5]
    """
    count = len(strength_n_s)
    if count <= wanted:
        return list(range(count))
    ends = np.linspace(1, count, wanted).round().astype(int)
    chosen = [0]
    for first, last in pairwise(ends):
        stretch = strength_n_s[first:last]
        chosen.append(int(first) + (int(stretch.argmax()) if stretch.any() else len(stretch) // 2))
    return chosen


def draw_contacts(picture: Image, camera: Camera, marks: ContactMarks) -> None:
    """Draw the contacts of a frame into a picture of the camera, in place: arrows first, points above them."""
    if not len(marks):
        return
    pixels, depths = camera.project(marks.segments_m.reshape(-1, 3))
    seen = (depths.reshape(-1, 2) > 0).all(1)
    ends = pixels.reshape(-1, 2, 2)
    colors = [tuple(map(int, color)) for color in marks.colors]
    for thickness, outline in ((4, True), (2, False)):
        for (start, tip), color in ((ends[k], colors[k]) for k in np.flatnonzero(seen)):
            _arrow(picture, start, tip, _PAPER if outline else color, thickness)
    for k in np.flatnonzero(seen):
        _dot(picture, ends[k, 0], colors[k])


def _shots(reader: RolloutReader) -> tuple[list[_Shot], float]:
    """Return the shown shots and their largest impulse [N s]."""
    numbers = range(min(ROLLOUTS, len(reader)))
    cameras = reader.cameras(0)
    if not cameras:
        raise InputDataError(f"{reader.path}: the rollouts have no images.", todo="synthesize it with images.")
    impulses = {number: np.linalg.norm(reader.read(number, "contacts/impulse_world"), axis=-1) for number in numbers}
    largest = max((float(values.max()) for values in impulses.values() if len(values)), default=0.0)
    pairs = [(number, name) for name in cameras for number in numbers][:ROLLOUTS]
    views = {name: _tile_camera(reader.camera(0, name)) for name in cameras}
    points = np.concatenate([reader.read(number, "contacts/pos_world") for number in numbers])
    scale = arrow_scale(largest, _LONGEST_ARROW * _metres_across(views[cameras[0]], points))
    return [_shot(reader, number, name, scale) for number, name in pairs], largest


def _shot(reader: RolloutReader, number: int, name: str, arrow_m_per_n_s: float) -> _Shot:
    contacts = [reader.contacts(number, frame) for frame in range(reader.rollouts[number].frames)]
    return _Shot(
        name=f"rollout {reader.rollouts[number].index}" + (f", {name}" if name != reader.cameras(number)[0] else ""),
        camera=_tile_camera(reader.camera(number, name)),
        times_s=np.asarray(reader.read(number, "time"), np.float64),
        images=reader.read(number, f"obs/{name}_image"),
        marks=tuple(contact_marks(rows, arrow_m_per_n_s) for rows in contacts),
        strength_n_s=np.array([np.linalg.norm(rows["impulse_world"], axis=-1).sum() for rows in contacts]),
    )


def _tile_camera(camera: Camera) -> Camera:
    width = int(np.clip(camera.width, *_TILE_WIDTH_PX))
    return camera.resized(2 * (width // 2), 2 * round(camera.height * width / camera.width / 2))


def _metres_across(camera: Camera, points_m: NDArray[np.float64]) -> float:
    """Return the height of the field of view at the median depth of the points [m], or at 1 m without points."""
    depths = camera.project(points_m)[1] if len(points_m) else np.zeros(0)
    depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
    return depth * camera.height / float(camera.K[1, 1])


def _film(shots: list[_Shot], largest_n_s: float) -> bytes:
    frames = max(len(shot.images) for shot in shots)
    shown = evenly(frames, _MOST_FILM_FRAMES)
    times_s = max(shots, key=lambda shot: len(shot.images)).times_s
    duration_s = float(times_s[-1] - times_s[0]) * SLOWER
    rate_hz = (len(shown) - 1) / duration_s if duration_s > 0 else 10.0
    columns = 1 if len(shots) == 1 else 2
    width = columns * (shots[0].camera.width + 4) - 4
    legend = _legend(width, largest_n_s, f"{SLOWER:g} times slower")
    return encoded_webm([_even(np.concatenate([grid, legend])) for grid in _grids(shots, shown, columns)], rate_hz)


def _grids(shots: list[_Shot], shown: list[int], columns: int) -> Iterator[Image]:
    for frame in shown:
        pictures = [shot.tile(min(frame, len(shot.images) - 1)) for shot in shots]
        pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % columns)
        yield contact_sheet([np.stack(pictures[k : k + columns]) for k in range(0, len(pictures), columns)])


def _even(picture: Image) -> Image:
    """Return a picture with even sides, as video codecs require."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)


def _legend(width: int, largest_n_s: float, also: str) -> Image:
    """Return a legend of the colours and arrows, in two lines if one is too short."""
    entries = [("dot", STICKING_RGB, "contact, sticking"), ("dot", SLIDING_RGB, "contact, sliding")]
    longest = f", at most {largest_n_s:.2g} N s" if largest_n_s > 0 else ""
    entries += [("arrow", _INK, f"impulse since the frame before{longest}"), *([("", _INK, also)] if also else [])]
    places, x, line = [], 10, 0
    for kind, _, text in entries:
        wide = (24 if kind else 0) + cv2.getTextSize(text, _FONT, _TEXT, 1)[0][0]
        if x + wide > width and x > 10:
            x, line = 10, line + 1
        places.append((x, line))
        x += wide + 26
    strip = np.full((_STRIP_PX + 24 * line, width, 3), 255, np.uint8)
    for (kind, color, text), (left, row) in zip(entries, places, strict=True):
        middle = np.array([left + 8, 17 + 24 * row], np.float64)
        if kind == "dot":
            _dot(strip, middle, color)
        elif kind == "arrow":
            _arrow(strip, middle + np.array([-6, 6]), middle + np.array([6, -6]), color, 2)
        place = (left + (24 if kind else 0), int(middle[1]) + 5)
        cv2.putText(strip, text, place, _FONT, _TEXT, _INK, 1, cv2.LINE_AA)
    return strip


def _dot(picture: Image, pixel: NDArray[np.float64], color: tuple[int, ...]) -> None:
    place = _sixteenths(pixel)
    cv2.circle(picture, place, 5 * 16, _PAPER, -1, cv2.LINE_AA, 4)
    cv2.circle(picture, place, round(3.7 * 16), color, -1, cv2.LINE_AA, 4)


def _arrow(
    picture: Image, start: NDArray[np.float64], tip: NDArray[np.float64], color: tuple[int, ...], thickness: int
) -> None:
    length = float(np.linalg.norm(tip - start))
    if not 2.0 < length < 1e5:
        return
    first, last = (_sixteenths(pixel) for pixel in (start, tip))
    cv2.arrowedLine(picture, first, last, color, thickness, cv2.LINE_AA, 4, min(0.4, 9.0 / length))


def _sixteenths(pixel: NDArray[np.float64]) -> tuple[int, int]:
    """Return pixel coordinates for OpenCV with 4 fractional bits; its pixel centres are at integers, ours at .5."""
    x, y = np.clip(np.round((pixel - 0.5) * 16), -1e8, 1e8)
    return int(x), int(y)


def _title(picture: Image, text: str) -> None:
    """Write a title into the top left corner, white on a darkened background, in place."""
    wide = cv2.getTextSize(text, _FONT, _TEXT, 1)[0][0]
    ground = picture[:24, : wide + 16]
    ground[:] = ground // 3
    cv2.putText(picture, text, (8, 17), _FONT, _TEXT, _PAPER, 1, cv2.LINE_AA)


def _noted(summary: DatasetSummary, note: str) -> DatasetSummary:
    return summary.model_copy(update={"notes": (*summary.notes, note)})
