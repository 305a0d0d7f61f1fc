"""Cells of text files that people write: numbers, and what a message shows of a cell."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from ...schemas import InputDataError
from ...schemas.regular_files import read_text_file

MOST_SHOWN = 60
"""Number of characters of a cell that a message shows."""
LARGEST = 1e12
"""Largest magnitude of a measured number, in any unit of seconds, metres or radians that a track is written in."""


def number_of(text: str) -> float:
    """Return the number that a text states in decimal or exponential notation.

    `float` alone takes `1_000`, and the digits of every script, in which few typing errors are seen.

    Raises:
        ValueError: If it is no such number.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"no number: {shown(text)}")
    return float(text)


def shown(text: str) -> str:
    """Return a cell as a message shows it: quoted, short, without control characters."""
    text = text.strip()
    text = text if len(text) <= MOST_SHOWN else text[:MOST_SHOWN] + "..."
    return f"'{text}'" if text.isprintable() else ascii(text)


def csv_rows(path: Path, text: str | None = None, delimiter: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield the number, from 1, of the line on which a row of a CSV file ends, and its cells.

    Args:
        path: The file, in UTF-8 with or without a byte order mark.
        text: Its text, if it was read already.
        delimiter: What separates cells.

    Raises:
        InputDataError: If it is no regular file, no text, or no CSV, with the line.
    """
    text = read_text_file(path, "utf-8-sig") if text is None else text
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        for row in reader:
            yield reader.line_num, row
    except csv.Error as error:
        raise InputDataError(f"{path}, line {reader.line_num}: no CSV: {error}.", todo="correct the line.") from None
