"""A robot of ROS 2 acts through `cgwm.Controller` or `cgwm.HandController`: topics in, topics out.

    ros2 run ... or: python examples/ros2_control.py MODEL TASK.toml [hand]

| topic | message | what |
| --- | --- | --- |
| `joint_states` | `sensor_msgs/JointState` | joints by name, in |
| `object_pose` | `geometry_msgs/PoseStamped` | the object in the frame of the task's world, in |
| `joint_targets` | `trajectory_msgs/JointTrajectory` | the targets at the end of the next command, out |

States older than two commands are not used: the controller then holds the last command and counts it, and raises after
`bad_states` in a row, at which the node stops publishing.
"""

from __future__ import annotations

import sys
from typing import Any, Protocol

import numpy as np

from cgwm import ControlState

STALE = 2.0
"""Largest age of a state in units of a command."""


class Commands(Protocol):
    """What a controller has."""

    @property
    def interval_s(self) -> float:
        """Length of a command [s]."""
        ...

    def command(self, state: ControlState | None, now_s: float | None = None) -> dict[str, float]:
        """Return targets by joint name, for a command that acts from a time [s] on."""
        ...


def seconds(stamp: Any) -> float:
    """Return a `builtin_interfaces/Time` in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


class ControlNode:
    """Subscriptions, a timer and a publisher around a controller.

    Args:
        node: A node of rclpy.
        controller: The controller.
        messages: Classes of the messages: JointState, PoseStamped, JointTrajectory, JointTrajectoryPoint.
    """

    def __init__(self, node: Any, controller: Commands, messages: Any) -> None:
        self.node, self.controller, self.messages = node, controller, messages
        self.joints: Any = None
        self.pose: Any = None
        node.create_subscription(messages.JointState, "joint_states", self._joints, 1)
        node.create_subscription(messages.PoseStamped, "object_pose", self._pose, 1)
        self.out = node.create_publisher(messages.JointTrajectory, "joint_targets", 1)
        self.timer = node.create_timer(controller.interval_s, self.tick)

    def _joints(self, message: Any) -> None:
        self.joints = message

    def _pose(self, message: Any) -> None:
        self.pose = message

    def state(self, now: float) -> ControlState | None:
        """Return the newest state at a time [s]; None where joints or object were not measured lately."""
        if self.joints is None or self.pose is None or len(self.joints.position) != len(self.joints.name):
            return None
        measured = seconds(self.pose.header.stamp)
        if now - min(measured, seconds(self.joints.header.stamp)) > STALE * self.controller.interval_s:
            return None
        place, turn = self.pose.pose.position, self.pose.pose.orientation
        speeds = self.joints.velocity
        return ControlState(
            time_s=measured,
            joints=dict(zip(self.joints.name, self.joints.position, strict=True)),
            joint_speeds=dict(zip(self.joints.name, speeds, strict=True))
            if len(speeds) == len(self.joints.name)
            else None,
            position_m=np.array([place.x, place.y, place.z]),
            quat_wxyz=np.array([turn.w, turn.x, turn.y, turn.z]),
        )

    def tick(self) -> None:
        """Publish the targets at the end of the next command."""
        now = 1e-9 * self.node.get_clock().now().nanoseconds
        targets = self.controller.command(self.state(now), now)  # what happens since the state is predicted
        if not targets:
            return
        message, point = self.messages.JointTrajectory(), self.messages.JointTrajectoryPoint()
        message.joint_names, point.positions = list(targets), list(targets.values())
        point.time_from_start.sec = int(self.controller.interval_s)
        point.time_from_start.nanosec = round(1e9 * (self.controller.interval_s % 1))
        message.points = [point]
        self.out.publish(message)


def main() -> None:
    """Spin until the controller loses the state, or an interrupt."""
    from types import SimpleNamespace

    import rclpy  # pyright: ignore[reportMissingImports]
    from geometry_msgs.msg import PoseStamped  # pyright: ignore[reportMissingImports]
    from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # pyright: ignore[reportMissingImports]

    from cgwm import Controller, HandController

    kind = HandController if sys.argv[3:] == ["hand"] else Controller
    rclpy.init()
    node = rclpy.create_node("cgwm_control")
    names = {"JointState": JointState, "PoseStamped": PoseStamped, "JointTrajectory": JointTrajectory}
    messages = SimpleNamespace(**names, JointTrajectoryPoint=JointTrajectoryPoint)
    ControlNode(node, kind(sys.argv[1], sys.argv[2]), messages)
    try:
        rclpy.spin(node)  # a NotConvergedError of the controller ends it
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
