"""Reading of an articulated body from a URDF or MJCF file."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from ...schemas import InputDataError
from .articulation import Articulation
from .mjcf import read_mjcf
from .urdf import read_urdf


def read_articulation(path: Path | str, bare_links: bool = False) -> Articulation:
    """Read the links and joints of a robot.

    Args:
        path: A URDF file (root element <robot>) or an MJCF file (<mujoco>).
        bare_links: Whether links with mass may have no collision geometry.

    Raises:
        InputDataError: If the file is not readable, or has what a chain cannot have: loops, mimic joints, joints of
            other kinds than hinge, slide and fixed, links that nothing can touch, meshes in millimetres.
    """
    path = Path(path)
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise InputDataError(
            f"{path}: it cannot be read: {error.strerror}.",
            "a URDF or MJCF file.",
            "check the path, and that the file may be read.",
        ) from error
    except ElementTree.ParseError:
        root = _without_prefixes(path)
    if root.tag == "robot":
        found = read_urdf(path, root)
    elif root.tag == "mujoco":
        found = read_mjcf(path)
    else:
        raise InputDataError(
            f"{path}: its root element is <{root.tag}>.",
            "<robot> (URDF) or <mujoco> (MJCF).",
            "name the URDF or MJCF file of the robot.",
        )
    found.require_metres()
    if not bare_links:
        found.require_geometry()
    return found


def _without_prefixes(path: Path) -> ElementTree.Element:
    """Read a file whose prefixes, as drake:, are not declared; elements with one are left unread."""
    parser = ElementTree.XMLPullParser(["start"])
    text = path.read_text(encoding="utf-8", errors="replace")
    for prefix in ("drake", "gazebo", "xacro"):
        text = text.replace(f"<{prefix}:", f"<{prefix}_").replace(f"</{prefix}:", f"</{prefix}_")
    try:
        parser.feed(text)
        parser.close()
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputDataError(
            f"{path}: it is not XML: {error}.", "a URDF or MJCF file.", "correct the file at that place."
        ) from error
