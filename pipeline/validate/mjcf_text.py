"""What a rollout's attribute `model_file` may hold: MJCF that a simulator reads without opening any other file."""

from __future__ import annotations

from xml.etree import ElementTree

from ...schemas.regular_files import leads_outside

MOST_CHARACTERS = 1 << 26
"""Longest text; that of a million spheres is about as long."""
_DECLARATION = "<!DOCTYPE"
"""What declares entities, by which a short text may grow without end or name files."""


def mjcf_fault(text: str) -> str | None:
    """Return what keeps a text from being MJCF that stands alone, or None.

    No tree is built, so that neither depth nor count of the elements matters.

    >>> mjcf_fault("<mujoco/>"), mjcf_fault("<mujoco><mesh file='/etc/passwd'/></mujoco>")
    (None, 'names the file /etc/passwd, which lies outside')
    """
    if len(text) > MOST_CHARACTERS:
        return f"has {len(text)} characters; at most {MOST_CHARACTERS} are read"
    if _DECLARATION in text.upper():
        return "declares a document type, which MJCF does not"
    parser = ElementTree.XMLParser(target=_Elements())
    try:
        parser.feed(text)
        parser.close()
    except ElementTree.ParseError as error:
        return f"is no XML: {error}"
    except UnicodeError:
        return "is no XML: it holds what is no character"
    except _RefusedError as error:
        return str(error)
    return None


class _RefusedError(Exception):
    """An element that may not be there, in words."""


class _Elements:
    """Looks at the elements one by one, as the parser finds them."""

    def __init__(self) -> None:
        self._first = True

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Look at an element.

        Raises:
            _RefusedError: If it is another root than `mujoco`, includes a file, or names one outside.
        """
        name = tag.rpartition("}")[2]
        if self._first and name != "mujoco":
            raise _RefusedError("is XML with another root than mujoco")
        self._first = False
        if name.lower() == "include":
            raise _RefusedError("includes a file")
        for key, value in attributes.items():
            if (key.startswith("file") or key.endswith(("file", "dir"))) and (leads_outside(value) or "://" in value):
                raise _RefusedError(f"names the file {value}, which lies outside")

    def close(self) -> None:
        """End the document."""
