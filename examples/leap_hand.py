"""A LEAP hand turns an object with `cgwm.HandController`: adapter to the hand's own Python interface.

    git clone https://github.com/leap-hand/LEAP_Hand_API
    cd LEAP_Hand_API/python && python .../examples/leap_hand.py MODEL TASK.toml

`LeapNode` of that repository is what is spoken to: `read_pos_vel()` and `set_leap(positions)`, 16 motors in the order
of their numbers, radians, where pi is the joint's zero and larger values close it. The task's hand is the URDF whose
joints are named "0" to "15" by these numbers. Where the object is must come from a tracker of your own.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from cgwm import ControlState

ZERO_RAD = math.pi
"""Reading of a motor where its joint is 0 [rad]."""
MOTORS = tuple(str(number) for number in range(16))
"""Names of the joints, in the order of the motors."""

Pose = tuple[Sequence[float], Sequence[float]]
"""Position [m] and orientation (w, x, y, z) of the object in the world of the task."""


class Commands(Protocol):
    """What a controller has."""

    def command(self, state: ControlState | None) -> dict[str, float]:
        """Return targets by joint name."""
        ...


class LeapHand:
    """The hand, by joint name.

    Args:
        node: A `LeapNode`.
        names: Names of the joints, in the order of the motors.
    """

    def __init__(self, node: Any, names: Sequence[str] = MOTORS) -> None:
        self.node, self.names = node, tuple(names)

    def state(self, time_s: float, pose: Pose | None) -> ControlState | None:
        """Return the measured state; None where the object was not seen."""
        if pose is None:
            return None
        values, speeds = self.node.read_pos_vel()
        return ControlState(
            time_s=time_s,
            joints=dict(zip(self.names, map(float, np.asarray(values) - ZERO_RAD), strict=True)),
            joint_speeds=dict(zip(self.names, map(float, speeds), strict=True)),
            position_m=np.asarray(pose[0], float),
            quat_wxyz=np.asarray(pose[1], float),
        )

    def send(self, targets: Mapping[str, float]) -> None:
        """Send targets by joint name [rad]; joints that are left out keep theirs."""
        now = np.array(self.node.curr_pos, float)
        for index, name in enumerate(self.names):
            if name in targets:
                now[index] = targets[name] + ZERO_RAD
        self.node.set_leap(now)


def drive(
    controller: Commands,
    hand: LeapHand,
    track: Callable[[], Pose | None],
    interval_s: float,
    commands: int,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Send commands at a rate; a `NotConvergedError` of the controller, for lost states, ends it with the hand still.

    Args:
        controller: The controller.
        hand: The hand.
        track: Returns the pose of the object, None where it is not seen.
        interval_s: Length of a command [s].
        commands: Number of commands.
        clock: Time [s].
        sleep: Waits [s].
    """
    begun = clock()
    for number in range(commands):
        targets = controller.command(hand.state(clock() - begun, track()))
        hand.send(targets)
        sleep(max(0.0, begun + (number + 1) * interval_s - clock()))


def main() -> None:
    """Drive the hand until it is interrupted."""
    from main import LeapNode  # pyright: ignore[reportMissingImports]

    from cgwm import HandController

    controller = HandController(sys.argv[1], sys.argv[2])

    def track() -> Pose | None:
        raise NotImplementedError("return the pose of the object from your tracker here.")

    drive(controller, LeapHand(LeapNode()), track, controller.interval_s, commands=10**9)


if __name__ == "__main__":
    main()
