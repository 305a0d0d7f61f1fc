"""Thresholds as fields of frozen dataclasses: the value, and in the field's metadata what is known about it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

NOT_KNOWN, NOT_MEASURED = "not known", "not measured alone"


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """What is known about a threshold."""

    name: str
    """Name of the field."""
    value: Any
    """The value in use."""
    unit: str
    """Unit of the value; "1" for ratios and counts."""
    decides: str
    """What the threshold decides."""
    calibrated_on: str
    """Data or argument that the value follows from."""
    error_rates: str
    """False alarms and misses, on data other than those of the calibration where nothing else is said."""
    false_alarms: tuple[int, int] | None
    """Number of false alarms, and of data sets without an effect that it was counted on; None where not counted."""


def threshold(
    value: Any,
    unit: str,
    decides: str,
    calibrated_on: str = NOT_KNOWN,
    error_rates: str = NOT_MEASURED,
    false_alarms: tuple[int, int] | None = None,
) -> Any:
    """Return a dataclass field with a value in use and what is known about it; see `Threshold`."""
    known = {
        "unit": unit,
        "decides": decides,
        "calibrated_on": calibrated_on,
        "error_rates": error_rates,
        "false_alarms": false_alarms,
    }
    return field(default=value, metadata=known)


def thresholds_of(group: Any) -> list[Threshold]:
    """Return the thresholds of a group, in their order."""
    return [Threshold(name=one.name, value=getattr(group, one.name), **one.metadata) for one in fields(group)]
