"""The calibration target: a ChArUco board on a sheet of A4 paper, as PDF or SVG.

Ten by seven squares of 26 mm, 260 x 182 mm together, fit on A4 and US Letter. A marker of five by five bits in a frame
of one bit lies in each white square. Intrinsics do not depend on the size of the print, only on its proportions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ....datasets.io.atomic import new_file
from ....schemas import UsageError
from ....schemas.intrinsics import TargetSheet

COLUMNS, ROWS, SQUARE_MM, MARKER_MM = 10, 7, 26.0, 19.25
SHEET_MM = (297.0, 210.0)
SIGN = "cgwm: ChArUco board, 10 x 7 squares of 26 mm, DICT_5X5_50"
"""What marks the files, and is printed below the board."""
_BITS, _FRAME = 5, 1
_POINT_MM = 25.4 / 72
_BYTES = "latin-1"

Rectangle = tuple[float, float, float, float]
"""Left, top, width and height [mm], from the top left corner of the sheet."""


def charuco_board() -> cv2.aruco.CharucoBoard:
    """Return OpenCV's board, in millimetres."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    return cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE_MM, MARKER_MM, dictionary)


def black_rectangles() -> list[Rectangle]:
    """Return the black parts of the sheet: squares, and the bits of the markers."""
    left, top = (0.5 * (SHEET_MM[0] - COLUMNS * SQUARE_MM), 0.5 * (SHEET_MM[1] - ROWS * SQUARE_MM))
    squares = [
        (left + SQUARE_MM * column, top + SQUARE_MM * row, SQUARE_MM, SQUARE_MM)
        for row in range(ROWS)
        for column in range(COLUMNS)
        if (row + column) % 2 == 0
    ]
    board, modules = charuco_board(), _BITS + 2 * _FRAME
    bit = MARKER_MM / modules
    for identifier, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
        x, y = np.asarray(corners)[:, :2].min(0)
        code = np.asarray(board.getDictionary().generateImageMarker(int(identifier), modules))
        for row, line in enumerate(code == 0):
            squares += [(left + x + bit * k, top + y + bit * row, bit * n, bit) for k, n in _runs(line)]
    return squares


def _runs(line: np.ndarray) -> list[tuple[int, int]]:
    """Return the first place and the length of each run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, line, False].astype(int)))
    return [(int(first), int(last - first)) for first, last in edges.reshape(-1, 2)]


def print_target(path: Path | str, overwrite: bool = False) -> TargetSheet:
    """Write the board as a PDF or SVG file of true size.

    Args:
        path: The file, .pdf or .svg.
        overwrite: Replace a board that was written before.

    Raises:
        UsageError: If the suffix is another one, or the file exists and is none of cgwm's boards.
    """
    path = Path(path)
    writers = {".pdf": _pdf, ".svg": _svg}
    if path.suffix.lower() not in writers:
        raise UsageError(
            f"{path}: a board is printed from .pdf or .svg.",
            "a name with one of these suffixes.",
            "choose a name with one of these endings.",
        )
    with new_file(path, "calibration target", overwrite) as temporary:
        temporary.write_bytes(writers[path.suffix.lower()](black_rectangles()))
    return TargetSheet(path=str(path), width_mm=COLUMNS * SQUARE_MM, height_mm=ROWS * SQUARE_MM, square_mm=SQUARE_MM)


def _svg(rectangles: Sequence[Rectangle]) -> bytes:
    width, height = SHEET_MM
    shapes = "".join(f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}"/>\n' for x, y, w, h in rectangles)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">\n<!-- {SIGN} -->\n<rect width="100%" height="100%" fill="white"/>\n'
        f'{shapes}<text x="18.5" y="204" font-size="3.5" font-family="sans-serif">{SIGN}</text>\n</svg>\n'
    ).encode(_BYTES)


def _pdf(rectangles: Sequence[Rectangle]) -> bytes:
    """Return a page of PDF 1.4 (ISO 32000-1, 7.5): its objects, the table of their places, and the trailer."""
    width, height = (side / _POINT_MM for side in SHEET_MM)
    places = [
        f"{x / _POINT_MM:.4f} {height - (y + h) / _POINT_MM:.4f} {w / _POINT_MM:.4f} {h / _POINT_MM:.4f} re"
        for x, y, w, h in rectangles
    ]
    drawn = "\n".join([*places, "f", f"BT /F1 9 Tf 52.4 17 Td ({SIGN}) Tj ET"])
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>",
        f"<< /Length {len(drawn)} >>\nstream\n{drawn}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    text, starts = f"%PDF-1.4\n% {SIGN}\n", []
    for number, body in enumerate(objects, 1):
        starts.append(len(text))
        text += f"{number} 0 obj\n{body}\nendobj\n"
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    trailer = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(text)}\n%%EOF\n"
    return f"{text}xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}{trailer}".encode(_BYTES)
