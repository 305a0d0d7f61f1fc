"""Scale error of the measured positions."""

from __future__ import annotations

from dataclasses import replace

from .effect import Effect, EffectParameter, Poses, Values


class LengthScale(Effect):
    """p_measured = (1 + s) p_true."""

    name = "length_scale"
    summary = "Positions measured on a wrong scale, as from a marker of another size than given."
    formula = "p_measured = (1 + s) p_true"
    # a marker that was printed to fit the page is 3 to 5 % too small
    parameters = (EffectParameter(name="s", unit="1", scale=0.01, limit=0.7, plausible=0.05),)
    phase = "measurement"
    reveals = "flight of a body whose size is known, down to its impact; a known distance"
    source = "definition"

    def observe(self, values: Values, poses: Poses) -> Poses:
        """Return the poses on the measured scale."""
        return replace(poses, position_m=poses.position_m * (1 + values["s"])[:, None, None, None])
