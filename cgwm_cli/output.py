"""Formatting of summaries as plain text: aligned tables, numbers with units, warnings."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence


def table(rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> str:
    """Align the columns of a table: text to the left, numbers to the right.

    >>> print(table([["translation", "8.1 mm"], ["rotation", "12.0 deg"]]))
      translation    8.1 mm
      rotation     12.0 deg
    """
    lines = [list(header), *map(list, rows)] if header else [list(row) for row in rows]
    if not lines:
        return ""
    widths = [max(len(line[k]) for line in lines if k < len(line)) for k in range(max(map(len, lines)))]
    numeric = [all(_is_number(row[k]) for row in rows if k < len(row)) for k in range(len(widths))]
    return "\n".join(
        ("  " + "  ".join(_pad(cell, widths[k], numeric[k]) for k, cell in enumerate(line))).rstrip() for line in lines
    )


def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """Write a number with its unit; a dash if there is none.

    >>> quantity(0.0081234, "m"), quantity(None, "m"), quantity(25.0, "dB")
    ('0.00812 m', '-', '25 dB')
    """
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}g} {unit}".rstrip()


def millimetres(value_m: float | None) -> str:
    """Write a length given in metres in millimetres.

    >>> millimetres(0.0123)
    '12.3 mm'
    """
    return "-" if value_m is None else f"{value_m * 1e3:.1f} mm"


def warnings(messages: Sequence[str]) -> list[str]:
    """Write warnings as lines of a summary; those that say the same of several episodes are one."""
    from ..datasets.io.repeated_warnings import fold_repeated

    return [f"warning: {message}" for message in fold_repeated(messages)]


def next_line(*words: object) -> str:
    """Write the command to type next, quoted as a shell needs it.

    >>> next_line("cgwm", "compare", "my m0", "capture")
    "Next: cgwm compare 'my m0' capture"
    """
    return f"Next: {shlex.join(str(word) for word in words)}"


def _pad(cell: str, width: int, right: bool) -> str:
    return cell.rjust(width) if right else cell.ljust(width)


def _is_number(cell: str) -> bool:
    return cell == "-" or cell[:1].isdigit() or (cell[:1] in "+-" and cell[1:2].isdigit())
