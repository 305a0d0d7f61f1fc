"""When a second effect in flight is selected: it explains most of what is left, or repeats from episode to episode."""

from types import SimpleNamespace

import pytest
import torch
from cgwm.pipeline.diagnose.evidence.effect_selection import SelectionStep
from cgwm.pipeline.diagnose.evidence.falsification import Repetition
from cgwm.pipeline.diagnose.flight import search as flight_search

CLEAR = Repetition(scatter=2.0, p_value=1e-9, without_best=1e-6, beyond_one=50.0)
OF_ONE = Repetition(scatter=2.0, p_value=1e-9, without_best=0.6, beyond_one=50.0)


@pytest.mark.parametrize(
    ("cost", "repeated", "loss", "named"),
    [
        (1250.0, CLEAR, 3.0, True),  # bursts and tilts are the rest
        (1250.0, OF_ONE, 3.0, False),
        (1050.0, OF_ONE, 3.0, True),  # nothing else is left
        (1250.0, CLEAR, 4.5, False),  # other flights are predicted worse
    ],
)
def test_a_second_effect_explains_most_or_repeats(
    monkeypatch: pytest.MonkeyPatch, cost: float, repeated: Repetition, loss: float, named: bool
) -> None:
    def step(name: str, cost: float, repetition: Repetition, flagged: bool = True) -> SelectionStep:
        refitted = SimpleNamespace(cost=cost, world=name, segments=(SimpleNamespace(dof=torch.tensor([1000.0])),))
        one = SimpleNamespace(name=name, refitted=refitted, repetition=repetition)
        return SelectionStep((one,) * 10, (one,), flagged)  # pyright: ignore[reportArgumentType]

    steps = iter([step("a", 1400.0, CLEAR), step("b", cost, repeated), step("c", cost, CLEAR, flagged=False)])
    losses = {"a": 4.0, "b": loss}
    monkeypatch.setattr(flight_search, "select_next", lambda *_: next(steps))
    monkeypatch.setattr(flight_search, "held_out_loss", lambda _, world: losses[world])
    prepared = SimpleNamespace(groups=(0,), has_orientation=True)
    flight = SimpleNamespace(dof=torch.tensor([1000.0]))
    found = flight_search._forward_selection(prepared, flight, "none", [], 1.0)  # pyright: ignore[reportArgumentType]
    assert [one.best.name for one in found[0]] == ["a", "b"][: 1 + named]
