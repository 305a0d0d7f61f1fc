"""Page, sections, tables and numbers of an HTML report: one self-contained file that loads nothing."""

from __future__ import annotations

import base64
import html
import math
import os
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from ...datasets.io.repeated_warnings import fold_repeated

NEGLIGIBLE = 1e-12
"""Largest magnitude that is written as zero, as rounding error, in any unit that occurs."""
LEAST_SECTIONS = 3
"""Minimum number of sections for a list of contents."""
MOST_COLUMNS = 3
"""Largest number of columns that a narrow screen shows side by side; of wider tables it shows each row as a list."""
_BEGINNING = re.compile(r"^[a-z](?=[a-z]* )")
"""First letter of a text that begins with a word, not with a name of a file or an option."""
_POWER = re.compile(r"(?<=[A-Za-z])[23]")
_HEADING = re.compile(r'<h2 id="([^"]+)">(.*?)</h2>')


def read_asset(module: str, name: str) -> str:
    """Return the text of a style sheet or script in the folder `assets` next to a module, after a line break.

    Args:
        module: Full name of the module, its `__name__`.
        name: Name of the file.
    """
    return "\n" + files(module.rpartition(".")[0]).joinpath("assets", name).read_text(encoding="utf-8")


STYLE = read_asset(__name__, "page.css")
SCRIPT = read_asset(__name__, "page.js")


def page(title: str, body: Sequence[str], style: str = "", script: str = "", made_of: str = "") -> str:
    """Return a whole HTML document, with a list of contents before its first section.

    Args:
        title: Title in the browser's title bar.
        body: Pieces of HTML, in order.
        style: Additional rules for the style sheet.
        script: Script that runs after that of every page.
        made_of: What the page shows, see `page_file.made_of`; the same command replaces a page of the same.
    """
    mark = f'<meta name="cgwm-made-of" content="{text(made_of)}">\n' if made_of else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="generator" content="cgwm">\n'
        f"{mark}"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # The page needs nothing from the network, so it may not ask for anything either.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; media-src data:; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n"
        f"<title>{text(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(_with_contents(body))
        + f"\n</main>\n<script>{SCRIPT}{script}</script>\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Return a value as text, with the special characters of HTML escaped."""
    return html.escape(str(value))


def section(title: str, *pieces: str) -> str:
    """Return a section with its heading, which the list of contents links to; empty pieces are omitted."""
    heading = f'<h2 id="{_anchor(title)}">{text(title)}</h2>'
    return "\n".join(["<section>", heading, *(piece for piece in pieces if piece), "</section>"])


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"


def _with_contents(body: Sequence[str]) -> list[str]:
    """Return the pieces of a page with a list of contents before the first section, if there are several."""
    found = [heading for piece in body for heading in _HEADING.findall(piece)]
    if len(found) < LEAST_SECTIONS:
        return list(body)
    first = next(k for k, piece in enumerate(body) if _HEADING.search(piece))
    links = "".join(f'<a href="#{anchor}">{title}</a>' for anchor, title in found)
    return [*body[:first], f'<nav class="contents" aria-label="contents">{links}</nav>', *body[first:]]


def link(words: str, target: Path | str, page: Path) -> str:
    """Return a link from a page on disk to a file or folder beside it, which stays right if both are moved together."""
    return way_link(words, os.path.relpath(os.path.realpath(target), os.path.realpath(page.parent)))


def way_link(words: str, way: str) -> str:
    """Return a link to a file or folder whose way from the page's folder is known."""
    return f'<a href="{text(quote(way))}">{text(words)}</a>'


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names as they are listed in a sentence.

    >>> listed(["a"]), listed(["a", "b"]), listed(["a", "b", "c"], "or")
    ('a', 'a and b', 'a, b or c')
    """
    return f" {last} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def command(words: str) -> str:
    """Return a command to type, as it would be typed."""
    return f"<pre><code>{text(words)}</code></pre>"


def film(webm: bytes, words: str) -> str:
    """Return a film (WebM) that the page itself holds, and which begins by itself, without sound, again and again."""
    data = base64.b64encode(webm).decode("ascii")
    return (
        f'<video controls autoplay muted loop playsinline style="width:100%" aria-label="{text(words)}" '
        f'src="data:video/webm;base64,{data}"></video>'
    )


def folded(summary: str, *pieces: str) -> str:
    """Return pieces that are shown on a click."""
    return f"<details><summary>{text(summary)}</summary>{''.join(pieces)}</details>"


def cautions(messages: Sequence[str]) -> str:
    """Return the box of warnings, those that say the same of several episodes as one; empty without any."""
    said = [_BEGINNING.sub(lambda first: first[0].upper(), words) for words in fold_repeated(messages)]
    return f'<div class="warnings">{"".join(map(paragraph, said))}</div>' if said else ""


def paragraph(words: str, style: str = "") -> str:
    """Return a paragraph of plain text."""
    mark = f' class="{style}"' if style else ""
    return f"<p{mark}>{text(words)}</p>"


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[int] = (),
    strong: Sequence[int] = (),
    sorts: bool = False,
) -> str:
    """Return a table whose cells are HTML.

    Args:
        header: Column names, plain text.
        rows: Cells by row.
        numeric: Indices of the columns that are aligned to the right.
        strong: Indices of the rows in bold.
        sorts: A click on a heading sorts the rows.
    """
    wide = len(header) > MOST_COLUMNS

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=num' if k in numeric else ''}{_label(header[k]) if wide and tag == 'td' else ''}>"
            f"{cell}</{tag}>"
            for k, cell in enumerate(row)
        )

    lines = [f"<tr{' class=strong' if i in strong else ''}>{cells('td', row)}</tr>" for i, row in enumerate(rows)]
    head = f"<thead><tr>{cells('th', [text(name) for name in header])}</tr></thead>"
    kinds = " ".join([*["wide"] * wide, *["sortable"] * sorts])
    mark = f' class="{kinds}"' if kinds else ""
    return f'<div class="scroll"><table{mark}>{head}<tbody>{"".join(lines)}</tbody></table></div>'


def _label(name: str) -> str:
    """Return the attribute from which a narrow screen takes the name of a cell's column."""
    return f' data-label="{text(name)}"'


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


def unit_words(unit: str) -> str:
    """Return a unit as it follows a number, as HTML; empty for the unit 1.

    >>> unit_words("m/s2"), unit_words("1")
    (' m/s²', '')
    """
    return "" if unit == "1" else f" {unit_text(unit)}"


def unit_text(unit: str) -> str:
    """Return a unit as HTML, with its powers raised.

    >>> unit_text("kg m2"), unit_text("1/s2")
    ('kg m²', '1/s²')
    """
    return _POWER.sub(lambda found: "²³"[int(found[0]) - 2], text(unit))


def fixed(value: float | None, places: int = 1, scale: float = 1.0) -> str:
    """Write a number times `scale` with a fixed number of decimals; an en dash if there is none.

    >>> fixed(0.01234, 1, 1e3), fixed(None)
    ('12.3', '–')
    """
    return "–" if value is None or not math.isfinite(value) else f"{value * scale:.{places}f}".replace("-", "−")
