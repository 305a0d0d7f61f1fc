"""Progress bars on stderr, only if it is a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable

from tqdm import tqdm

from ...schemas.printable import printable


def progress(
    iterable: Iterable | None = None, desc: str = "", total: int | None = None, unit: str = "it", initial: int = 0
) -> tqdm:
    """Iterate with a tqdm bar on stderr; no bar if stderr is no terminal or a dumb one, or CGWM_QUIET is set.

    `initial` is the start of the bar for resumed work. The bar's `set_postfix_str` shows a physical quantity after the
    rate ("rms 1.8 mm"). Without an iterable, call `update(n)` on the returned bar.
    """
    return tqdm(
        iterable,
        desc=printable(desc),
        total=total,
        unit=unit,
        initial=initial,
        file=sys.stderr,
        disable=not _watched(),
        leave=False,
    )


def note(text: str) -> None:
    """Write a line on stderr above the running bars, under the same condition as a bar."""
    if _watched():
        tqdm.write(printable(text), file=sys.stderr)


def _watched() -> bool:
    return sys.stderr.isatty() and os.environ.get("TERM") != "dumb" and not os.environ.get("CGWM_QUIET")
