"""Fitted parameters as `model.json` has them: estimate, interval, state and warning, from fitted coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ...schemas import FittedParameter
from ..optimization.uncertainty import REACH
from ..physics.parameters import Parameter, base_name
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.preparation


def fitted_parameter(parameter: Parameter, coordinate: float, std: float, reach: float = REACH) -> FittedParameter:
    """Return a parameter as `model.json` has it, from its estimate and standard error in fitted coordinates.

    Args:
        parameter: The parameter.
        coordinate: Its estimate.
        std: Its standard error.
        reach: Half of the interval, in standard errors.
    """
    low, high = parameter.limits
    estimate, *interval = (
        float(parameter.decode(torch.tensor(z, dtype=torch.float64)))
        for z in (coordinate, *(min(max(coordinate + k * reach * std, low), high) for k in (-1, 1)))
    )
    estimate = min(max(estimate, parameter.bounds[0]), parameter.bounds[1])  # rounding may lead past a bound
    state = "on_bound" if min(coordinate - low, high - coordinate) < 1e-6 * (high - low) else "fitted"
    if std > LIMITS.unobservable_share * parameter.prior[1]:
        state = "not_observable"
    factor = "factor of the second moment of mass given or derived before; " if ".moment_" in parameter.name else ""
    return FittedParameter(
        name=parameter.name,
        unit=parameter.unit,
        estimate=estimate,
        std_error=std * (estimate if parameter.logarithmic else 1.0),
        interval_95=(interval[0], interval[1]),
        bounds=parameter.bounds,
        state=state,
        note=f"{factor}{parameter.reveals} would reveal it",
    )


def bound_warnings(parameters: Sequence[Parameter], fitted: Sequence[FittedParameter]) -> list[str]:
    """Return a warning for each parameter that ended on a bound, with what that means."""
    meaning = {parameter.name: parameter.at_bounds for parameter in parameters}
    texts = []
    for found in fitted:
        if found.state != "on_bound" or found.bounds is None:
            continue
        upper = found.estimate - found.bounds[0] > found.bounds[1] - found.estimate
        side, unit = ("upper" if upper else "lower"), "" if found.unit == "1" else f" {found.unit}"
        texts.append(
            f"{found.name} ended on its {side} bound ({found.estimate:.3g}{unit}), which is not an estimate: "
            f"{(meaning.get(found.name) or meaning[base_name(found.name)])[upper]}."
        )
    return texts
