"""Files of pages: their names by default, and whether an existing one is of the same command and inputs."""

from __future__ import annotations

import hashlib
import html
import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from ...datasets.io.outputs import RECORD
from ...schemas.regular_files import real_path
from .page import link

_HEAD_BYTES = 1 << 15
_MARK = re.compile(r'<meta name="cgwm-made-of" content="([^"]*)">')
_KINDS = {"compare": "comparison", "diagnose": "diagnosis"}
"""In words, what the commands write."""


def page_beside(models: Sequence[Path], verb: str, *words: str) -> Path:
    """Return the path of a page that is named after its models, beside the first one and in no output of cgwm.

    The name of a model within an output, such as a ladder, has that one's name before it.

    Args:
        models: The models.
        verb: The command that writes the page, the first word of its name.
        words: Its last words.
    """
    names = [name.replace("/", "-") for name in short_names([os.fspath(model) for model in models])]
    outputs = [_outermost(model) for model in models]
    first = outputs[0]
    if first is not None and all(one == first for one in outputs):
        names = [first.name, *names]
    else:
        names = [name if one is None else f"{one.name}-{name}" for name, one in zip(names, outputs, strict=True)]
    folder = models[0].parent if first is None else first.parent
    return folder / f"{'-'.join([verb, *names, *words])}.html"


def _outermost(model: Path) -> Path | None:
    """Return the outermost output of cgwm that holds a model; None for one that lies in none."""
    outputs = [above for above in real_path(model).parents if (above / RECORD).is_file()]
    return outputs[-1] if outputs else None


def pages_beside(place: Path, models: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return the pages about models that lie beside a page: comparisons, diagnoses, and the ladder that holds a model.

    Args:
        place: The page itself, which is not listed.
        models: The models that it shows.

    Returns:
        Kind of each page, in words, and its path.
    """
    own = {_from(place, model) for model in models}
    found: list[tuple[str, Path]] = []
    for page in sorted(place.parent.glob("[!.]*.html")):
        verb, _, *inputs = _mark_in(page).split() or [""] * 2
        if verb in _KINDS and own & {*inputs} and page.name != place.name:
            found.append((_KINDS[verb], page))
    ladders = dict.fromkeys(Path(model).parent / "improve.html" for model in models)
    return [*found, *(("ladder of models", page) for page in ladders if page.is_file())]


def links_beside(place: Path, models: Sequence[Path], capture: Path) -> list[tuple[str, str]]:
    """Return the rows of a table of files, with links to models, capture and the pages that lie beside a page."""
    rows = [("model", link(str(model), model, place)) for model in models]
    rows.append(("capture", link(str(capture), capture, place)))
    return [*rows, *((kind, link(page.name, page, place)) for kind, page in pages_beside(place, models))]


def short_names(models: Sequence[str]) -> list[str]:
    """Return the shortest ends of the models' paths that distinguish them.

    >>> short_names(["a/m0", "b/m1"]), short_names(["a/m", "b/m"])
    (['m0', 'm1'], ['a/m', 'b/m'])
    """
    parts = [os.path.normpath(name).split(os.sep) for name in models]
    for length in range(1, max(map(len, parts))):
        ends = ["/".join(part[-length:]) for part in parts]
        if len(set(ends)) == len(ends):
            return ends
    return list(models)


def made_of(page: Path, verb: str, inputs: Sequence[Path], *words: str) -> str:
    """Return by what a page is recognised: its command, and where its inputs lie from its folder.

    Args:
        page: The page's path.
        verb: The command that writes it.
        inputs: The directories that it shows, in order.
        words: What else makes another page of the same inputs, such as the split.
    """
    places = [_from(page, path) for path in inputs]
    return " ".join([verb, hashlib.sha256(chr(0).join([*places, *words]).encode()).hexdigest(), *places])


def shows_the_same(page: Path, mark: str) -> bool:
    """Return whether a page is one that cgwm wrote with this mark of :func:`made_of`."""
    # the digest is of the places, which follow it for whoever looks for pages about a model
    return _mark_in(page).split()[:2] == mark.split()[:2]


def _mark_in(page: Path) -> str:
    """Return the mark of a page that cgwm wrote; empty for other files."""
    try:
        with page.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return ""
    found = _MARK.search(head.decode(errors="replace"))
    return html.unescape(found[1]) if found else ""


def _from(page: Path, path: Path) -> str:
    """Return the way from a page's folder to a path, without spaces."""
    return quote(os.path.relpath(real_path(path), real_path(page).parent))
