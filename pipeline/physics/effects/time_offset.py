"""Delay between commands and measurements."""

from __future__ import annotations

from torch import Tensor

from .effect import Effect, EffectParameter, Values


class TimeOffset(Effect):
    """t_measured = t_true + o; the commands of driven bodies are on the true clock."""

    name = "time_offset"
    summary = "Measurements that are late (or early) against the commands."
    formula = "t_measured = t_true + o, the commands on the true clock"
    parameters = (EffectParameter(name="o", unit="s", scale=0.01, limit=0.2),)
    phase = "measurement"
    needs = ("driven",)
    reveals = "sudden starts, stops and turns of a driven body that touches a free one"
    source = "definition; without a command the same motion begins earlier or later, which is not observable"

    def times(self, values: Values, times_s: Tensor) -> Tensor:
        """Return the true times (B, T) [s]."""
        return times_s - values["o"][:, None]
