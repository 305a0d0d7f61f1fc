"""Scale error of the clock."""

from __future__ import annotations

from torch import Tensor

from .effect import Effect, EffectParameter, Values


class ClockScale(Effect):
    """t_measured = (1 + s) t_true."""

    name = "clock_scale"
    summary = "Times on a wrong scale, as from a camera with another frame rate than given."
    formula = "t_measured = (1 + s) t_true"
    # quartz clocks err by up to 1e-4; 29.97 Hz that is given as 30 Hz by 1e-3; 30 Hz that was 50 Hz by 0.67
    parameters = (EffectParameter(name="s", unit="1", scale=0.01, limit=0.7, plausible=0.002),)
    phase = "measurement"
    reveals = "long free flight, with a clock in the image"
    source = "definition"

    def times(self, values: Values, times_s: Tensor) -> Tensor:
        """Return the true times (B, T) [s]."""
        return times_s / (1 + values["s"])[:, None]
