"""A fit of slides whose cost is that of one segment at a wrong minimum goes on from the state of another fit there."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cgwm.pipeline.segments.sliding import variant_fits
from helpers.worlds import state_of


def fit_of(chi2: list[float], place: float) -> Any:
    state = state_of(*[((place + k, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0)) for k in range(2)], count=1)
    state = type(state)(*(getattr(state, key).reshape(2, 1, -1) for key in type(state).__dataclass_fields__))
    segments = SimpleNamespace(
        observations=SimpleNamespace(state=state), with_state=lambda found: SimpleNamespace(started=found)
    )
    return SimpleNamespace(segments=segments, chi2=torch.tensor(chi2), cost=sum(chi2), values=torch.zeros(1, 1))


def test_a_segment_that_stalled_starts_at_the_state_of_another_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    starts = []

    def fitted(world: Any, variants: Any, given: Any, known: Any, iterations: int) -> list[Any]:
        starts.append(given[0][0].started.position_m[:, 0, 0].tolist())
        return [SimpleNamespace(cost=15.0)]

    monkeypatch.setattr(variant_fits, "fit_sliding", fitted)
    started: Any = SimpleNamespace(segments=SimpleNamespace(world=None), flight_parameters=())
    fits = [("true", fit_of([10.0, 1e6], 0.0)), ("other", fit_of([1000.0, 1000.0], 10.0))]
    found = variant_fits._unstuck(fits, started)  # pyright: ignore[reportArgumentType]
    assert starts == [[0.0, 11.0]]
    assert [fit.cost for _, fit in found] == [15.0, 2000.0]
