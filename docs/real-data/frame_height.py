"""A custom effect: a tracking frame that is higher or lower than it is said to be (docs/real-data.md)."""

from __future__ import annotations

from dataclasses import replace

import torch
from cgwm.pipeline.physics.effects import Effect, EffectParameter, Poses, Values


class FrameHeight(Effect):
    """p_measured = p_true + h up; with @episode a tracker that finds its floor anew for each recording."""

    name = "frame_height"
    summary = "A tracking system whose origin is not at the height that it is said to be."
    formula = "p_measured = p_true + h up"
    parameters = (EffectParameter(name="h", unit="m", scale=0.001, limit=0.05),)
    phase = "measurement"
    reveals = "rest on the ground"
    source = "definition"

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the poses in the shifted frame."""
        up = poses.up if poses.up is not None else torch.eye(3).to(poses.position_m)[2:]
        return replace(poses, position_m=poses.position_m + (values["h"][:, None] * up)[:, None, None])
