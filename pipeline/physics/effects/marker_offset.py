"""Offset of the tracked point from the body frame's origin."""

from __future__ import annotations

from dataclasses import replace

from ...geometry.rotation import quat_rotate
from .effect import Effect, EffectParameter, Poses, Values, vector


class MarkerOffset(Effect):
    """p_measured = p + R d; the collision shape stays."""

    name = "marker_offset"
    summary = "A tracked point that is not the origin of the body's frame."
    formula = "p_measured = p + R (d_x, d_y, d_z), d in the body frame; the collision shape stays"
    parameters = tuple(EffectParameter(name=f"d_{axis}", unit="m", scale=0.003, limit=0.05) for axis in "xyz")
    phase = "measurement"
    needs = ("orientation",)
    reveals = "free flight with fast spin about different axes, then rest on different sides (against com_offset)"
    source = "definition"

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the poses of the tracked points."""
        offset = vector(values, "d_x", "d_y", "d_z")[:, None, None]
        return replace(poses, position_m=poses.position_m + quat_rotate(poses.quat_wxyz, offset))
