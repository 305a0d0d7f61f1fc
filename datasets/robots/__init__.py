"""Articulated bodies on disk: URDF and MJCF files."""

from .articulation import Articulation, GeometryOfLink, JointOfRobot, LinkOfRobot
from .reading import read_articulation

__all__ = ["Articulation", "GeometryOfLink", "JointOfRobot", "LinkOfRobot", "read_articulation"]
