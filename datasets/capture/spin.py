"""How far a tracked body turns between neighbouring frames: beyond a limit the sense of its spin cannot be told."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...schemas import InputDataError
from ..shapes.turns import turn_between
from .tracks import Track

MOST_TURN_RAD = 0.8 * np.pi
"""Largest rotation between neighbouring frames [rad]: from half a turn on, a spin looks like one in the other sense;
the margin is for changes of the spin and for noise."""
STEPS_IN_A_ROW = 3
"""Number of such rotations in a row that is refused; single ones are errors of the tracking."""
ALIGNED = 0.7
"""Smallest cosine between the axes of neighbouring rotations: those of a spin agree, up to their sense, while wrong
orientations turn about any axis."""
GAP = 1.5
"""Time between neighbouring frames, in units of its median, beyond which they are not neighbours."""


def require_told_spin(path: Path, body: str, track: Track) -> None:
    """Refuse a track whose orientation turns too far from frame to frame.

    Args:
        path: Its file, for messages.
        body: Name of the body.
        track: The track.

    Raises:
        InputDataError: If several neighbouring rotations in a row exceed `MOST_TURN_RAD`, with the frame rate needed.
    """
    if track.quat_wxyz is None or len(track) < STEPS_IN_A_ROW + 1:
        return
    step, between = np.diff(track.time_s), turn_between(track.quat_wxyz[:-1], track.quat_wxyz[1:])
    turn = np.linalg.norm(between, axis=1)
    axes = between / np.maximum(turn, 1e-12)[:, None]
    far = (turn > MOST_TURN_RAD) & (step <= GAP * np.median(step))
    pairs = far[:-1] & far[1:] & (np.abs((axes[:-1] * axes[1:]).sum(1)) > ALIGNED)
    rows = np.lib.stride_tricks.sliding_window_view(pairs, STEPS_IN_A_ROW - 1).all(1)
    if not rows.any():
        return
    first = int(rows.argmax())
    rate_hz = 1 / float(np.median(step))
    # what is seen as an angle a may be a turn of 2 pi - a in the other sense
    needed_hz = rate_hz * (2 * np.pi - float(turn[first : first + STEPS_IN_A_ROW].min())) / MOST_TURN_RAD
    raise InputDataError(
        f"{path}: body '{body}' turns by {np.degrees(turn[first]):.0f} deg from one frame to the next at "
        f"{track.time_s[first]:.3f} s, so that at {rate_hz:.0f} frames/s the sense of its spin cannot be told.",
        f"turns of at most {np.degrees(MOST_TURN_RAD):.0f} deg between frames.",
        f"record at {np.ceil(needed_hz):.0f} frames/s or more; if the orientation was not measured, leave the columns "
        "qw, qx, qy, qz out.",
    )
