"""Files of pages: their names by default, and whether an existing one is of the same command and inputs."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path

from ...datasets.io.outputs import RECORD
from ...schemas.regular_files import real_path
from .page import link

_HEAD_BYTES = 1 << 12


def page_beside(model: Path, name: str) -> Path:
    """Return the path of a page of this name beside a model, and in no output of cgwm."""
    outputs = [above for above in real_path(model).parents if (above / RECORD).is_file()]
    folder = outputs[-1].parent if outputs else model.parent
    return folder / name


def pages_beside(place: Path, models: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return the pages about models that lie beside a page: comparisons, diagnoses, and the ladder that holds a model.

    Args:
        place: The page itself, which is not listed.
        models: The models that it shows.

    Returns:
        Kind of each page, in words, and its path.
    """
    found: dict[Path, str] = {}
    for name in (os.path.basename(os.path.normpath(model)) for model in models):
        about = re.compile(rf"(compare|diagnose)-(?:.+-)?{re.escape(name)}(?:-.+)?\.html")
        for page in sorted(place.parent.glob("*.html")):
            if (kind := about.fullmatch(page.name)) and page.name != place.name:
                found.setdefault(page, {"compare": "comparison", "diagnose": "diagnosis"}[kind[1]])
    for ladder in dict.fromkeys(Path(model).parent / "improve.html" for model in models):
        if ladder.is_file():
            found[ladder] = "ladder of models"
    return [(kind, page) for page, kind in found.items()]


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
    folder = real_path(page).parent
    places = [os.path.relpath(real_path(path), folder) for path in inputs]
    return f"{verb} {hashlib.sha256(chr(0).join([*places, *words]).encode()).hexdigest()}"


def shows_the_same(page: Path, mark: str) -> bool:
    """Return whether a page is one that cgwm wrote with this mark of :func:`made_of`."""
    try:
        with page.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return False
    return f'<meta name="cgwm-made-of" content="{mark}">'.encode() in head
