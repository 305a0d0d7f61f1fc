"""The adapters of examples/, against fakes that speak the messages of the LEAP hand and of ROS 2."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.schemas import NotConvergedError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Steps:
    """A controller that moves joint `7` or `a` on by 0.1 rad at each state, and stops after two bad ones."""

    interval_s = 0.1

    def __init__(self, joint: str) -> None:
        self.joint, self.seen, self.bad, self.last = joint, [], 0, {}
        self.now_s: float | None = None

    def command(self, state: Any, now_s: float | None = None) -> dict[str, float]:
        self.seen.append(state)
        self.now_s = now_s
        self.bad = 0 if state is not None else self.bad + 1
        if self.bad >= 2:
            raise NotConvergedError("2 states in a row are missing.")
        if state is not None:
            self.last = {self.joint: state.joints[self.joint] + 0.1}
        return dict(self.last)


class FakeLeapNode:
    """Motors that are where they were sent."""

    def __init__(self) -> None:
        self.curr_pos = np.full(16, math.pi)
        self.sent: list[np.ndarray] = []

    def read_pos_vel(self) -> tuple[np.ndarray, np.ndarray]:
        return self.curr_pos.copy(), np.zeros(16)

    def set_leap(self, pose: np.ndarray) -> None:
        self.curr_pos = np.array(pose)
        self.sent.append(self.curr_pos)


def test_the_leap_hand_moves_the_named_joint_in_its_own_units() -> None:
    leap, node, controller = example("leap_hand"), FakeLeapNode(), Steps("7")
    poses = iter([((0, 0, 0.1), (1, 0, 0, 0)), ((0, 0, 0.1), (1, 0, 0, 0)), None])
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    leap.drive(controller, leap.LeapHand(node), lambda: next(poses), 0.1, 3, lambda: now[0], sleep)
    assert [round(float(sent[7] - math.pi), 9) for sent in node.sent] == [0.1, 0.2, 0.2]  # the last one is held
    assert all((np.delete(sent, 7) == math.pi).all() for sent in node.sent)
    assert [None if state is None else round(state.time_s, 9) for state in controller.seen] == [0.0, 0.1, None]
    assert set(controller.seen[0].joints) == {str(number) for number in range(16)}


def test_a_leap_hand_whose_object_is_lost_is_left_where_it_is() -> None:
    leap, node = example("leap_hand"), FakeLeapNode()
    with pytest.raises(NotConvergedError):
        leap.drive(Steps("0"), leap.LeapHand(node), lambda: None, 0.1, 9, lambda: 0.0, lambda _: None)
    assert len(node.sent) == 1 and (node.sent[0] == math.pi).all()


class FakeNode:
    """A node of rclpy whose topics are lists."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Any] = {}
        self.published: list[Any] = []
        self.nanoseconds = 0

    def create_subscription(self, kind: object, topic: str, callback: Any, depth: int) -> None:
        self.callbacks[topic] = callback

    def create_publisher(self, kind: object, topic: str, depth: int) -> Any:
        assert topic == "joint_targets"
        return SimpleNamespace(publish=self.published.append)

    def create_timer(self, period: float, callback: Any) -> float:
        return period

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.nanoseconds))


def stamped(sec: int, nanosec: int) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


def messages() -> SimpleNamespace:
    return SimpleNamespace(
        JointState=object,
        PoseStamped=object,
        JointTrajectory=SimpleNamespace,
        JointTrajectoryPoint=lambda: SimpleNamespace(time_from_start=SimpleNamespace(sec=0, nanosec=0)),
    )


def test_ros_topics_become_states_and_commands_trajectories() -> None:
    ros, fake, controller = example("ros2_control"), FakeNode(), Steps("a")
    node = ros.ControlNode(fake, controller, messages())
    node.tick()  # nothing was measured yet, and nothing is commanded
    assert (fake.published, controller.seen) == ([], [None])
    fake.callbacks["joint_states"](
        SimpleNamespace(header=stamped(12, 480_000_000), name=["b", "a"], position=[0.5, 0.25], velocity=[])
    )
    pose = SimpleNamespace(position=SimpleNamespace(x=1, y=2, z=3), orientation=SimpleNamespace(x=0, y=0, z=1, w=0))
    fake.callbacks["object_pose"](SimpleNamespace(header=stamped(12, 500_000_000), pose=pose))
    fake.nanoseconds = 12_550_000_000
    node.tick()
    state = controller.seen[-1]
    assert controller.now_s == pytest.approx(12.55)  # later than the state, which is predicted forward
    assert (state.time_s, state.joints, state.joint_speeds) == (12.5, {"b": 0.5, "a": 0.25}, None)
    assert (state.position_m.tolist(), state.quat_wxyz.tolist()) == ([1, 2, 3], [0, 0, 0, 1])
    sent = fake.published[-1]
    assert (sent.joint_names, sent.points[0].positions) == (["a"], [0.35])
    assert sent.points[0].time_from_start == SimpleNamespace(sec=0, nanosec=100_000_000)
    fake.nanoseconds = 12_900_000_000  # the state is stale: the last command is held, then the controller stops
    node.tick()
    assert fake.published[-1].points[0].positions == [0.35]
    with pytest.raises(NotConvergedError):
        node.tick()


def test_joint_states_without_positions_are_no_state() -> None:
    """A driver may publish efforts alone."""
    ros, fake, controller = example("ros2_control"), FakeNode(), Steps("a")
    node = ros.ControlNode(fake, controller, messages())
    pose = SimpleNamespace(position=SimpleNamespace(x=1, y=2, z=3), orientation=SimpleNamespace(x=0, y=0, z=1, w=0))
    fake.callbacks["object_pose"](SimpleNamespace(header=stamped(0, 0), pose=pose))
    fake.callbacks["joint_states"](SimpleNamespace(header=stamped(0, 0), name=["a"], position=[], velocity=[]))
    node.tick()
    assert controller.seen == [None]
