"""Text for a terminal: names from files may hold characters that move the cursor, recolour or reorder what is read."""

from __future__ import annotations

import re

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 without tab and newline, DEL, C1: with ESC and CSI
    "\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"  # separators of lines, and of the direction of text
    "\ud800-\udfff]"  # bytes of a file name that are no UTF-8
)
_CONTINUED = re.compile(r"\n(?! |\d+\. )")


def printable(text: str) -> str:
    r"""Escape the control characters of a text but tabs and newlines, also those of text direction.

    >>> print(printable("cube\x1b[2J\u202egpj"))
    cube\x1b[2J\u202egpj
    """
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def typed_path(path: object) -> str:
    r"""Return a path as it is typed in a command: in double quotes where a shell would take it apart.

    >>> print(f"run 'cgwm fit {typed_path('my capture')} --out {typed_path('model')}'")
    run 'cgwm fit "my capture" --out model'
    """
    text = str(path)
    if re.fullmatch(r"[\w@%+=:,./-]+", text):
        return text
    return '"' + re.sub(r'([\\"$`])', r"\\\1", text) + '"'


def printable_json(document: str) -> str:
    r"""Escape the same characters in a JSON document, whose content stays the same.

    >>> printable_json('{"name": "cube\x9b"}')
    '{"name": "cube\\u009b"}'
    """
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", document)


def in_one_line(text: str) -> str:
    r"""Escape the newlines of a part of a message, except before a line that is indented or numbered.

    A name with a newline in it can then add no line to a message that looks like one of cgwm's own.

    >>> print(in_one_line("a\nNext: run this.csv: faults:\n  one"))
    a\nNext: run this.csv: faults:
      one
    """
    return _CONTINUED.sub(r"\\n", text)
