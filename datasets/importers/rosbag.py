"""Import of poses from ROS bags (ROS 1 .bag, ROS 2 directories, .mcap) by the library rosbags, without ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...schemas import InputDataError, UsageError, did_you_mean
from ...schemas.imports import ImportResult
from ...schemas.regular_files import require_regular_file
from ..capture.files import entries_of, files_under, optional_file
from ..capture.tracks import Track
from ..io.atomic import new_directory
from ..io.outputs import reads
from ..io.progress import note
from .recordings import Units, require_name, write_tracks

POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""Types of messages that hold a pose and its time, and where it is in them."""
TRANSFORMS = "tf2_msgs/msg/TFMessage"
"""A list of TransformStamped, of several frames."""


@reads("source")
def import_rosbag(
    source: Path | str,
    out: Path | str,
    topic: str | None = None,
    body: str = "body",
    up: Literal["z", "y"] = "z",
    n_train: int | None = None,
    n_test: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> ImportResult:
    """Write the poses of one topic as a capture, one episode a bag.

    Shape, mass and ground are for you to add to its manifest.

    The time of a pose is that of its header. A pose that stands twice with one time counts once.

    Args:
        source: A bag, or a folder of bags.
        out: The capture directory to write.
        topic: Its name; may be left out where a bag has one topic of poses. Of transforms: `/tf:child_frame`.
        body: Name of the body.
        up: Which axis points up; gravity is set against it, numbers stay.
        n_train: Number of episodes to fit on; None: 60 %.
        n_test: Number of episodes to test on; None: the others.
        seed: Of the permutation.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If there is no such bag or topic, or its poses are no track.
        UsageError: If `out` exists, before anything is read; or if rosbags is not installed.
    """
    try:
        import_module("rosbags.highlevel")
    except ImportError:
        raise UsageError("ROS bags need the package rosbags.", todo="pip install 'cgwm[ros]'.") from None
    with new_directory(out, "capture", overwrite) as directory:
        require_name(body, "--body")
        bags = _bags(Path(source))
        tracks = ({body: _track(path, topic)} for path in bags)
        return write_tracks(directory, out, [path.stem for path in bags], tracks, up, (n_train, n_test, seed))


def _bags(source: Path) -> list[Path]:
    there = os.path.lexists(source)
    entries = entries_of(source) if source.is_dir() else []
    bags = [source] if there and _is_bag(source) else [path for path in entries if _is_bag(path)]
    if not bags:
        raise _no_bags(source, entries)
    return bags


def _no_bags(source: Path, entries: Sequence[Path]) -> InputDataError:
    """Return the error of a source without a bag, in which these entries were found."""
    messages = next((path for path in entries if path.suffix == ".db3"), None)
    what = f"no ROS bags{f', but {messages} without metadata.yaml' if messages else ''}"
    return InputDataError(
        f"{source}: {what if os.path.lexists(source) else 'no such file or directory'}.",
        "a .bag, a .mcap, a directory with metadata.yaml, or a folder of them.",
        "name the bag's .mcap or .bag file, or its folder.",
    )


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return optional_file(path / "metadata.yaml") is not None
    return path.suffix in (".bag", ".mcap") and require_regular_file(path) == path


def _track(path: Path, topic: str | None) -> Track:
    """Return the track on a topic; poses with the time of the one before are left out."""
    rows, name, frame = _read(path, topic)
    if not rows:
        shown = f" of '{frame}'" if frame else ""
        raise InputDataError(f"{path}: no poses{shown} on {name}.", todo="choose another: --topic NAME.")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    fresh = np.r_[True, np.diff(table[:, 0]) > 0]
    if not fresh.all():
        note(f"{path}: {np.count_nonzero(~fresh)} poses have the time of the one before and are left out")
    table = table[fresh]
    first = table[0, 0]
    return Units("m", "s").track(f"{path}: {name}", 1e-9 * (table[:, 0] - first), table[:, 1:4], table[:, 4:])


def _read(path: Path, topic: str | None) -> tuple[list[list[float]], str, str]:
    """Return the poses on a topic, as `_poses` yields them, and the topic and child frame that were chosen."""
    rosbags: Any = import_module("rosbags.highlevel")
    stores: Any = import_module("rosbags.typesys")
    for name in files_under(path) if path.is_dir() else ():  # each must be a regular file
        require_regular_file(path / name)
    try:
        with rosbags.AnyReader([path], default_typestore=stores.get_typestore(stores.Stores.LATEST)) as reader:
            name, frame = _chosen(path, reader, topic)
            return list(_poses(reader, name, frame)), name, frame
    except InputDataError:
        raise
    except Exception as error:  # the readers raise what their parsers raise: of struct, yaml, sqlite, their own
        reason = str(error)[:160].rstrip(".") or type(error).__name__
        raise InputDataError(
            f"{path}: not a ROS bag that can be read: {reason}.",
            "a whole .bag or .mcap, or a directory with metadata.yaml and the files that it names.",
            "record or copy it again; 'rosbag reindex' or 'ros2 bag reindex' mends one that was cut off.",
        ) from None


def _chosen(path: Path, reader: Any, topic: str | None) -> tuple[str, str]:
    """Return the topic, and the child frame where it holds transforms."""
    poses, transforms = _topics(reader, tuple(POSES)), _topics(reader, (TRANSFORMS,))
    name, _, frame = (topic or "").partition(":")
    if topic is None and len(poses) == 1:
        name = poses[0]
    if name in poses or (frame and name in transforms):
        return name, frame
    raise _no_such_topic(path, topic, len(poses), [*poses, *(f"{one}:CHILD_FRAME" for one in transforms)])


def _topics(reader: Any, kinds: Sequence[str]) -> list[str]:
    """Return the topics with messages of some types."""
    return sorted({connection.topic for connection in reader.connections if connection.msgtype in kinds})


def _no_such_topic(path: Path, topic: str | None, poses: int, legal: Sequence[str]) -> InputDataError:
    """Return the error of a topic that is not in a bag, or that must be chosen of several."""
    found = f"no topic of poses '{topic}'" if topic else f"{poses} topics of poses"
    nearest = did_you_mean(topic or "", legal)
    return InputDataError(f"{path}: {found}.", f"{', '.join(legal) or 'none is in it'}.{nearest}", "add --topic NAME.")


def _poses(reader: Any, topic: str, frame: str) -> Iterator[list[float]]:
    """Yield time [ns], position [m] and quat_wxyz; times in ns since 1970 are exact to 256 ns as floats."""
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, _, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        for one in message.transforms if connection.msgtype == TRANSFORMS else (message,):
            if frame and one.child_frame_id != frame:
                continue
            pose = attrgetter(POSES.get(connection.msgtype, "transform"))(one)
            stamp = one.header.stamp
            yield [float(stamp.sec * 1_000_000_000 + stamp.nanosec), *_pose(pose)]


def _pose(message: Any) -> list[float]:
    """Return position [m] and quat_wxyz of a pose or a transform."""
    place = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    return [place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z]
