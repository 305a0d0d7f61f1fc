"""Stepwise simulation of one environment with new commands for each interval, by the torch engine on any device.

`fused.stepping.FusedStepper` does the same on CUDA.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch

from ...schemas import UsageError
from .chains.joint_command import JointCommand
from .checks import require_physical, require_state
from .kinematic import Drive
from .rigid_body import Motion
from .rollout import Engine
from .state import State
from .world import World


class Stepper(Protocol):
    """Interface for the simulation of one environment by intervals of equal length, with the steps of one rollout."""

    def reset(self, state: State, drives: Mapping[str, Drive | JointCommand]) -> None:
        """Start from a state (1, nb, ...).

        Args:
            state: Poses and velocities of all bodies; driven ones are at the start of their commands.
            drives: Command of each driven body over one interval, which begins at time 0; of servos under the name of
                their chain.

        Raises:
            InputDataError: If the state is not finite.
        """
        ...

    def command(self, drives: Mapping[str, Drive | JointCommand]) -> None:
        """Set the commands of the driven bodies for the next interval."""
        ...

    def advance(self) -> State:
        """Simulate one interval, and return the state at its end (1, nb, ...)."""
        ...


class TorchStepper:
    """`Stepper` that uses the torch engine.

    Args:
        world: The world, with a batch of one.
        interval_s: Length of an interval [s].

    Raises:
        InputDataError: If masses, inertias, contact coefficients or the step cannot be simulated.
    """

    def __init__(self, world: World, interval_s: float) -> None:
        require_physical(world)
        self._world = world
        self._times = torch.tensor([[0.0, interval_s]], dtype=torch.float64).to(world.gravity)
        self._engine: Engine | None = None
        self._motions: list[Motion] = []

    def reset(self, state: State, drives: Mapping[str, Drive | JointCommand]) -> None:
        """See :class:`Stepper`."""
        require_state(state, self._world.body_names)
        self._engine = Engine(self._world, state, self._times, drives)
        self._motions = self._engine.begin(state)

    def command(self, drives: Mapping[str, Drive | JointCommand]) -> None:
        """See :class:`Stepper`."""
        self._motions = self._started().commanded(self._motions, drives)

    @torch.no_grad()
    def advance(self) -> State:
        """See :class:`Stepper`."""
        engine = self._started()
        for substep in range(engine.substeps[0]):
            self._motions, _ = engine.step(self._motions, 1, substep)
        return State(*engine.frame(self._motions))

    def _started(self) -> Engine:
        if self._engine is None:
            raise UsageError("the stepper has no state yet.", todo="call reset first.")
        return self._engine
