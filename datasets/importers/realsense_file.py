"""Reader of recordings of librealsense: ROS 1 bags (.bag, until 2.56) and SQLite files of ROS 2 (.db3, since then).

Source: files that librealsense 2.55 and 2.59 wrote of a camera in software, and `third-party/realsense-file` of its
repository. Streams are topics `/device_0/sensor_1/Color_0/image/data`; in .bag files they hold the pixels as they are,
behind which librealsense leaves four more bytes, in .db3 files PNG or JPEG. `tf` takes points of the reference stream
to the stream: p_stream = R p_reference + t [m].
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...schemas import InputDataError, UsageError
from ...schemas.regular_files import require_regular_file

Array = NDArray[np.float64]

_STREAM = re.compile(r"/device_\d+/sensor_\d+/(Color|Depth)_\d+")
_PNG_OF_DEPTH = b"\x89PNG"


class _Topics(Protocol):
    """Messages of a recording by topic."""

    def names(self) -> list[str]:
        """Return all topics."""
        ...

    def raw(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield the time [ns] and the bytes of each message of a topic, in order."""
        ...

    def read(self, topic: str) -> Any:
        """Return the first message of a topic."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class StreamGeometry:
    """Intrinsics of a stream, and its pose against the reference stream."""

    size: tuple[int, int]
    """Width and height [px]."""
    K: Array
    """Camera matrix [px], shape (3, 3); the middle of the first pixel is at 0.0."""
    lens: str
    """Name of the distortion's model."""
    distortion: Array
    """Its coefficients."""
    R_stream_reference: Array
    """Rotation, shape (3, 3)."""
    t_stream_reference: Array
    """Translation [m], shape (3,)."""


class RealSenseFile:
    """An opened recording."""

    def __init__(self, path: Path, topics: _Topics) -> None:
        self.path, self._topics = path, topics
        self._names = topics.names()
        self._old = path.suffix.lower() == ".bag"

    def stream(self, kind: str) -> str | None:
        """Return the first stream of a kind, `Color` or `Depth`, by the beginning of its topics; None if none is."""
        there = {match[0] for name in self._names if (match := _STREAM.match(name)) and match[1] == kind}
        return min((name for name in there if self._frames_topic(name)), default=None)

    def _frames_topic(self, stream: str) -> str | None:
        return next((name for name in self._names if name.startswith(f"{stream}/image/data")), None)

    def times(self, stream: str) -> NDArray[np.int64]:
        """Return the time of each frame [ns]."""
        return np.array([time for time, _ in self._raw(stream)], np.int64)

    def colors(self, stream: str, wanted: set[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames, or those of some numbers, BGR, shape (H, W, 3)."""
        for k, (_, raw) in enumerate(self._raw(stream)):
            if wanted is None or k in wanted:
                yield self._color(raw, f"{self.path}: frame {k} of {stream}")

    def depths(self, stream: str, wanted: set[int]) -> Iterator[tuple[int, NDArray[np.uint16]]]:
        """Yield number and raw depth (H, W) of some frames."""
        for k, (_, raw) in enumerate(self._raw(stream)):
            if k in wanted:
                yield k, self._depth(raw, f"{self.path}: frame {k} of {stream}")

    def depth_unit_m(self, stream: str) -> float:
        """Return the unit of raw depth [m]."""
        topic = f"{stream.rsplit('/', 1)[0]}/option/Depth_Units/value"
        value = float(self._topics.read(topic).data) if topic in self._names else 0.001
        if not 1e-6 <= value <= 0.1:
            raise InputDataError(f"{self.path}: a depth unit of {value:g} m.", "0.000001 to 0.1 m.", "record it again.")
        return value

    def geometry(self, stream: str) -> StreamGeometry:
        """Return intrinsics and pose of a stream."""
        R, t = self._pose(stream)
        if self._old:
            info = self._topics.read(f"{stream}/info/camera_info")
            size, K, D = (int(info.width), int(info.height)), np.array(info.K, float), np.array(info.D, float)
            K, lens = _matrix(K.reshape(3, 3), self.path), str(info.distortion_model)
            return StreamGeometry(size=size, K=K, lens=lens, distortion=D, R_stream_reference=R, t_stream_reference=t)
        values = _values(self._topics.read(f"{stream}/camera_info").data)
        fx, fy, cx, cy = (float(values[name]) for name in ("fx", "fy", "ppx", "ppy"))
        K = _matrix(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), self.path)
        size = int(values["width"]), int(values["height"])
        D = np.array(values["coeffs"].split(","), float)
        return StreamGeometry(
            size=size, K=K, lens=values["model"], distortion=D, R_stream_reference=R, t_stream_reference=t
        )

    def _pose(self, stream: str) -> tuple[Array, Array]:
        topic = next((name for name in self._names if name.startswith(f"{stream}/tf/")), None)
        if topic is None:
            return np.eye(3), np.zeros(3)
        if self._old:
            found = self._topics.read(topic)
            q, t = found.rotation, found.translation
            return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([t.x, t.y, t.z])
        values = _values(self._topics.read(topic).data)
        columns = np.array(values["rotation"].split(","), float).reshape(3, 3)
        return columns.T, np.array(values["translation"].split(","), float)

    def _raw(self, stream: str) -> Iterator[tuple[int, bytes]]:
        topic = self._frames_topic(stream)
        assert topic is not None  # the stream was found by it
        return self._topics.raw(topic)

    def _color(self, raw: bytes, where: str) -> NDArray[np.uint8]:
        if not self._old:
            return _decoded(_compressed(raw), cv2.IMREAD_COLOR, where)
        encoding, pixels = _image(raw, where)
        turned = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR}
        turned |= {"yuv422": cv2.COLOR_YUV2BGR_YUY2, "yuyv": cv2.COLOR_YUV2BGR_YUY2, "mono8": cv2.COLOR_GRAY2BGR}
        if encoding not in (*turned, "bgr8"):
            legal = ", ".join(sorted((*turned, "bgr8")))
            raise InputDataError(f"{where} has the encoding '{encoding}'.", f"{legal}.", "record colour as RGB8.")
        return np.asarray(pixels if encoding == "bgr8" else cv2.cvtColor(pixels, turned[encoding]), np.uint8)

    def _depth(self, raw: bytes, where: str) -> NDArray[np.uint16]:
        if self._old:
            _, pixels = _image(raw, where)
        else:
            data = _compressed(raw)
            pixels = _decoded(data[max(data.find(_PNG_OF_DEPTH), 0) :], cv2.IMREAD_UNCHANGED, where)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise InputDataError(f"{where} is no depth of 16 bits.", todo="record depth as Z16.")
        return np.asarray(pixels, np.uint16)


@contextmanager
def opened(path: Path) -> Iterator[RealSenseFile]:
    """Open a recording.

    Raises:
        InputDataError: If it is no such file, or is damaged.
        UsageError: If rosbags is not installed.
    """
    try:
        import_module("rosbags.highlevel")
    except ImportError:
        raise UsageError("RealSense recordings need the package rosbags.", todo="pip install 'cgwm[ros]'.") from None
    if path.suffix.lower() not in (".bag", ".db3"):
        raise InputDataError(
            f"{path}: no recording of a RealSense camera.",
            "a .bag or .db3 of librealsense.",
            "name a .bag file that a RealSense camera has recorded.",
        )
    require_regular_file(path)
    try:
        with _bag(path) if path.suffix.lower() == ".bag" else _database(path) as topics:
            yield RealSenseFile(path, topics)
    except InputDataError:
        raise
    except Exception as error:  # the readers raise what their parsers raise: of struct, sqlite, their own
        reason = str(error)[:160].rstrip(".") or type(error).__name__
        raise InputDataError(
            f"{path}: no recording of librealsense that can be read: {reason}.",
            "a whole .bag or .db3 of the RealSense Viewer or of rs-record.",
            "record or copy it again.",
        ) from None


class _Bag:
    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def names(self) -> list[str]:
        return sorted({connection.topic for connection in self._reader.connections})

    def raw(self, topic: str) -> Iterator[tuple[int, bytes]]:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        for _, time, raw in self._reader.messages(connections=connections):
            yield time, raw

    def read(self, topic: str) -> Any:
        connection = next(one for one in self._reader.connections if one.topic == topic)
        _, _, raw = next(self._reader.messages(connections=[connection]))
        return self._reader.deserialize(raw, connection.msgtype)


@contextmanager
def _bag(path: Path) -> Iterator[_Topics]:
    rosbags: Any = import_module("rosbags.highlevel")
    stores: Any = import_module("rosbags.typesys")
    with rosbags.AnyReader([path], default_typestore=stores.get_typestore(stores.Stores.LATEST)) as reader:
        yield _Bag(reader)


class _Database:
    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._topics = {
            name: (key, kind) for key, name, kind in connection.execute("SELECT id, name, type FROM topics")
        }

    def names(self) -> list[str]:
        return sorted(self._topics)

    def raw(self, topic: str) -> Iterator[tuple[int, bytes]]:
        chosen = "SELECT timestamp, data FROM messages WHERE topic_id = ? ORDER BY timestamp, id"
        yield from self._connection.execute(chosen, (self._topics[topic][0],))

    def read(self, topic: str) -> Any:
        stores: Any = import_module("rosbags.typesys")
        _, raw = next(self.raw(topic))
        return stores.get_typestore(stores.Stores.ROS2_HUMBLE).deserialize_cdr(raw, self._topics[topic][1])


@contextmanager
def _database(path: Path) -> Iterator[_Topics]:
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as connection:
        yield _Database(connection)


def _image(raw: bytes, where: str) -> tuple[str, NDArray[Any]]:
    """Return encoding and pixels of a sensor_msgs/Image of ROS 1.

    Fields: header (number, seconds, nanoseconds, frame), height, width, encoding, byte order, step, data; texts and
    data begin with their lengths. What stands behind them is skipped.
    """
    view = memoryview(raw)

    def number(at: int) -> int:
        return int.from_bytes(view[at : at + 4], "little")

    at = 16 + number(12)
    height, width = number(at), number(at + 4)
    length = number(at + 8)
    encoding = bytes(view[at + 12 : at + 12 + length]).decode("ascii")
    at += 12 + length + 1
    step, size = number(at), number(at + 4)
    data = np.frombuffer(view[at + 8 : at + 8 + size], np.uint8)
    if not (0 < width <= step <= 16 * width and height > 0 and len(data) == size == step * height):
        raise InputDataError(f"{where} is cut off.", todo="record or copy it again.")
    rows = data.reshape(height, step)
    if encoding in ("mono16", "16UC1"):
        return encoding, np.ascontiguousarray(rows[:, : 2 * width]).view("<u2")
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "yuv422": 2, "yuyv": 2}.get(encoding, 1)
    pixels = rows[:, : channels * width].reshape(height, width, -1)
    return encoding, np.ascontiguousarray(pixels[..., 0] if channels == 1 else pixels)


def _compressed(raw: bytes) -> bytes:
    """Return the data of a sensor_msgs/CompressedImage of ROS 2."""
    stores: Any = import_module("rosbags.typesys")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    return store.deserialize_cdr(raw, "sensor_msgs/msg/CompressedImage").data.tobytes()


def _decoded(data: bytes, flags: int, where: str) -> NDArray[Any]:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if pixels is None:
        raise InputDataError(f"{where} does not decode.", todo="record or copy it again.")
    return pixels


def _values(text: str) -> dict[str, str]:
    return dict(part.split("=", 1) for part in text.split(";") if "=" in part)


def _matrix(K: Array, path: Path) -> Array:
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputDataError(f"{path}: a stream without a focal length.", todo="record it again.")
    return K
