"""The file of a comparison's page: its name by default, and whether an existing one shows the same comparison."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ...datasets.io.outputs import RECORD
from ...schemas.regular_files import real_path
from ..report.page import text

_HEAD_BYTES = 1 << 12


def default_page(models: Sequence[Path]) -> Path:
    """Return the page's path by default: beside the first model, in no output of cgwm, named after the models."""
    place = real_path(models[0])
    outputs = [above for above in place.parents if (above / RECORD).is_file()]
    folder = outputs[-1].parent if outputs else models[0].parent
    names = (name.replace("/", "-") for name in short_names([os.fspath(model) for model in models]))
    return folder / f"compare-{'-'.join(names)}.html"


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


def page_title(models: Sequence[str], capture: str) -> str:
    """Return the title of the page, which tells what is compared; names are those of `short_names`, and a path."""
    return f"cgwm compare: {', '.join(models)} on {Path(capture).name or capture}"


def shows_the_same(page: Path, models: Sequence[Path], capture: Path) -> bool:
    """Return whether a page is a comparison of models and a capture of these names, which cgwm wrote."""
    try:
        with page.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return False
    title = page_title(short_names([os.fspath(model) for model in models]), os.fspath(capture))
    return f"<title>{text(title)}</title>".encode() in head
