"""A world taken on by one interval after the other, each with its own commands: on any device by the torch engine.

`FusedStepper` does the same on CUDA.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch

from .checks import require_physical, require_state
from .driven import Drive
from .motion import Motion
from .rollout import Engine
from .world import State, World


class Stepper(Protocol):
    """Takes one environment on by intervals of equal length; the same steps as one rollout over all of them."""

    def reset(self, state: State, drives: Mapping[str, Drive]) -> None:
        """Start anew from a state (1, nb, ...).

        Args:
            state: Where all bodies are; driven ones are where their commands begin.
            drives: For each driven body a command over one interval, which begins at time 0.

        Raises:
            InputDataError: If the start is not finite.
        """
        ...

    def command(self, drives: Mapping[str, Drive]) -> None:
        """Give the driven bodies the commands of the next interval."""
        ...

    def advance(self) -> State:
        """Take the world on by one interval, and return its state there (1, nb, ...)."""
        ...


class TorchStepper:
    """A `Stepper` by the torch engine.

    Args:
        world: The world, of one environment.
        interval_s: Length of an interval [s].

    Raises:
        InputDataError: If masses, inertias, contact numbers or the step cannot be simulated.
    """

    def __init__(self, world: World, interval_s: float) -> None:
        require_physical(world)
        self._world = world
        self._times = torch.tensor([[0.0, interval_s]], dtype=torch.float64).to(world.gravity)
        self._engine: Engine | None = None
        self._motions: list[Motion] = []

    def reset(self, state: State, drives: Mapping[str, Drive]) -> None:
        """See :class:`Stepper`."""
        require_state(state, self._world.body_names)
        self._engine = Engine(self._world, state, self._times, drives)
        self._motions = self._engine.begin(state)

    def command(self, drives: Mapping[str, Drive]) -> None:
        """See :class:`Stepper`."""
        assert self._engine is not None  # see reset
        self._motions = self._engine.commanded(self._motions, drives)

    @torch.no_grad()
    def advance(self) -> State:
        """See :class:`Stepper`."""
        engine = self._engine
        assert engine is not None  # see reset
        for substep in range(engine.substeps[0]):
            self._motions, _ = engine.step(self._motions, 1, substep)
        return State(*engine.frame(self._motions))
