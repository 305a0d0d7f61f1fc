"""Rotation of the measured frame against the true one."""

from __future__ import annotations

from dataclasses import replace

import torch

from ...geometry.rotation import quat_exp, quat_multiply, quat_rotate
from .effect import Effect, EffectParameter, Poses, Values, horizontal, vector


class FrameTilt(Effect):
    """Poses turned by the rotation vector tilt_x e_x + tilt_y e_y about the world's origin.

    Bodies move in the true frame, where gravity and ground are as given; so both are turned in the measured one.
    """

    name = "frame_tilt"
    summary = "A tracking system whose axes are not level: gravity and ground appear turned together."
    formula = "p_measured = R p_true, R_measured = R R_true, R = exp(tilt_x e_x + tilt_y e_y)"
    parameters = (
        EffectParameter(name="tilt_x", unit="rad", scale=0.02, limit=0.5),
        EffectParameter(name="tilt_y", unit="rad", scale=0.02, limit=0.5),
    )
    phase = "measurement"
    reveals = "free flight and rest on different places of the ground, whose heights then differ"
    source = "a rotation about the two horizontal axes; one about gravity is a choice of axes"

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the poses in the measured frame."""
        up = poses.up if poses.up is not None else torch.eye(3).to(poses.position_m)[2:]
        turn = quat_exp(horizontal(vector(values, "tilt_x", "tilt_y"), up))[:, None, None]
        return replace(
            poses,
            position_m=quat_rotate(turn, poses.position_m),
            quat_wxyz=quat_multiply(turn, poses.quat_wxyz),
        )
