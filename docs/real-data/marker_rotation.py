"""A custom effect: markers that are glued on turned against the body's faces (docs/real-data.md)."""

from __future__ import annotations

from dataclasses import replace

from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics.effects import Effect, EffectParameter, Poses, Values, vector


class MarkerRotation(Effect):
    """R_measured = R exp(turn), turn in the body frame."""

    name = "marker_rotation"
    summary = "A tracked frame that is turned against the body's shape."
    formula = "R_measured = R exp(turn_x, turn_y, turn_z), in the body frame"
    parameters = tuple(EffectParameter(name=f"turn_{axis}", unit="rad", scale=0.01, limit=0.3) for axis in "xyz")
    phase = "measurement"
    needs = ("spin",)
    reveals = "rest on different faces"
    source = "definition"

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the poses of the tracked frames."""
        turn = quat_exp(vector(values, "turn_x", "turn_y", "turn_z"))[:, None, None]
        return replace(poses, quat_wxyz=quat_multiply(poses.quat_wxyz, turn))
