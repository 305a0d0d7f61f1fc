"""Page, sections, tables and numbers of an HTML report: one self-contained file that loads nothing."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from importlib.resources import files

NEGLIGIBLE = 1e-12
"""Largest magnitude that is written as zero, as rounding error, in any unit that occurs."""


def read_asset(module: str, name: str) -> str:
    """Return the text of a style sheet or script in the folder `assets` next to a module, after a line break.

    Args:
        module: Full name of the module, its `__name__`.
        name: Name of the file.
    """
    return "\n" + files(module.rpartition(".")[0]).joinpath("assets", name).read_text(encoding="utf-8")


STYLE = read_asset(__name__, "page.css")
SCRIPT = read_asset(__name__, "page.js")


def page(title: str, body: Sequence[str], style: str = "", script: str = "") -> str:
    """Return a whole HTML document.

    Args:
        title: Title in the browser's title bar.
        body: Pieces of HTML, in order.
        style: Additional rules for the style sheet.
        script: Script that runs after that of every page.
    """
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="generator" content="cgwm">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # The page needs nothing from the network, so it may not ask for anything either.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n"
        f"<title>{text(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + f"\n</main>\n<script>{SCRIPT}{script}</script>\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Return a value as text, with the special characters of HTML escaped."""
    return html.escape(str(value))


def section(title: str, *pieces: str) -> str:
    """Return a section with its heading; empty pieces are omitted."""
    return "\n".join(["<section>", f"<h2>{text(title)}</h2>", *(piece for piece in pieces if piece), "</section>"])


def paragraph(words: str, style: str = "") -> str:
    """Return a paragraph of plain text."""
    mark = f' class="{style}"' if style else ""
    return f"<p{mark}>{text(words)}</p>"


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = (), strong: Sequence[int] = ()
) -> str:
    """Return a table whose cells are HTML.

    Args:
        header: Column names, plain text.
        rows: Cells by row.
        numeric: Indices of the columns that are aligned to the right.
        strong: Indices of the rows in bold.
    """

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(f"<{tag}{' class=num' if k in numeric else ''}>{cell}</{tag}>" for k, cell in enumerate(row))

    lines = [f"<tr{' class=strong' if i in strong else ''}>{cells('td', row)}</tr>" for i, row in enumerate(rows)]
    head = f"<thead><tr>{cells('th', [text(name) for name in header])}</tr></thead>"
    return f'<div class="scroll"><table>{head}<tbody>{"".join(lines)}</tbody></table></div>'


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """Return a table of names (plain text) and values (HTML)."""
    lines = "".join(f"<tr><th scope=row>{text(name)}</th><td>{value}</td></tr>" for name, value in rows)
    return f'<div class="scroll"><table>{lines}</table></div>'


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with significant digits, without exponent from 1e-5 to 1e6; an en dash if there is none.

    >>> number(0.00341), number(1234.5), number(None), number(3.2e-7), number(-2.0)
    ('0.00341', '1230', '–', '3.2e−07', '−2.00')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) < NEGLIGIBLE:
        return "0"
    written = f"{value:.{digits}g}"
    if 1e-5 <= abs(value) < 1e6:
        decimals = digits - 1 - math.floor(math.log10(abs(float(written))))
        written = f"{round(value, decimals):.{max(0, decimals)}f}"
    return written.replace("-", "−")


def fixed(value: float | None, places: int = 1, scale: float = 1.0) -> str:
    """Write a number times `scale` with a fixed number of decimals; an en dash if there is none.

    >>> fixed(0.01234, 1, 1e3), fixed(None)
    ('12.3', '–')
    """
    return "–" if value is None or not math.isfinite(value) else f"{value * scale:.{places}f}".replace("-", "−")
