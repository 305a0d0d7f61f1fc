"""Captures of the benchmark Fall and Push: six objects, three grounds, true cameras, ten tests each."""

from .capture import PARTS_FILE, make_capture, read_solid
from .materials import MATERIALS
from .objects import OBJECTS

__all__ = ["MATERIALS", "OBJECTS", "PARTS_FILE", "make_capture", "read_solid"]
