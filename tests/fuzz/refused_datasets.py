"""What has to be refused: datasets, by `validate` and by the exporters."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .edits import Edit, Row, array, field, kind_of, shard, twice
from .refused import DEEP, DIGITS

FILE = "dataset/dataset.json"
SHARD = "dataset/rollouts-0000-of-0001.h5"


def rows() -> Iterator[Row]:
    """Yield the tables."""
    for name, edit in CONTENT:
        yield Row(f"{name}: validate", "datasets", "dataset", edit, ("validate", "dataset"))
    for name, edit in CAMERAS:
        for form in ("validate", "bop", "nerfstudio", "lerobot"):
            words = (
                ("export", "dataset", "--to", form, "--out", "OUT") if form != "validate" else ("validate", "dataset")
            )
            if form != "lerobot" or "image" in name:
                yield Row(f"{name}: {form}", "exports", "dataset", edit, words)
    for name, edit in FILES:
        yield Row(f"{name}: validate", "datasets", "dataset", edit, ("validate", "dataset"))
        yield Row(f"{name}: merge", "datasets", "dataset", edit, ("merge", "dataset", "--out", "OUT.h5"))
    for name, edit in MANIFEST:
        yield Row(f"{name}: validate", "datasets", "dataset", edit, ("validate", "dataset"))


def _set(index: Any, value: Any) -> Any:
    def change(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[index] = value
        return values

    return change


def _attribute(at: str, name: str, value: Any) -> Edit:
    def change(file: h5py.File) -> None:
        demo = file["data"][sorted(file["data"])[0]]
        (demo[at] if at else demo).attrs[name] = value

    return shard(change)


def _splits(names: list[bytes]) -> Edit:
    def change(file: h5py.File) -> None:
        del file["mask/train"]
        file["mask/train"] = np.array(names)

    return shard(change)


def _linked(file: h5py.File) -> None:
    del file["data/demo_1"]
    file["data/demo_1"] = h5py.SoftLink("/data/demo_1")


CONTENT: tuple[tuple[str, Edit], ...] = (
    ("states that disagree with the bodies", array("states", lambda s: s + 0.1)),
    ("states with fewer columns", array("states", lambda s: s[:, :-1])),
    ("states of zeros", array("states", np.zeros_like)),
    ("positions with a NaN", array("bodies/pos", _set((2, 0, 0), np.nan))),
    ("positions in mm", array("bodies/pos", lambda p: 1000 * p)),
    ("velocities in mm/s", array("bodies/vel", lambda v: 1000 * v)),
    ("quaternions x y z w", array("bodies/quat_wxyz", lambda q: q[..., [1, 2, 3, 0]])),
    ("quaternions of norm 2", array("bodies/quat_wxyz", lambda q: 2 * q)),
    ("angular velocities of another sign", array("bodies/omega_body", lambda w: -w)),
    ("a mass of 0", array("bodies/mass", np.zeros_like)),
    ("a mass of another body", array("bodies/mass", lambda m: 5 * m)),
    ("an inertia that is negative", array("bodies/inertia", lambda i: -i)),
    ("a centre of mass 5 m away", array("bodies/com", lambda c: c + 5)),
    ("gravity up", array("bodies/gravity", lambda g: -g)),
    ("body names with control characters", array("bodies/names", lambda n: np.array([b"cu\x1bbe"]))),
    ("a body name that is another", array("bodies/names", lambda n: np.array([b"mug"]))),
    ("a motion that is none", array("bodies/motions", lambda n: np.array([b"flying"]))),
    ("visible_px of another count", array("bodies/visible_px", lambda v: v + 7)),
    ("times that stand", array("time", _set(3, 0.0))),
    ("times in ms", array("time", lambda t: 1000 * t)),
    ("times of NaN", array("time", _set(3, np.nan))),
    ("one time less", array("time", lambda t: t[:-1])),
    ("actions of NaN", array("actions", lambda a: np.full((len(a), 1), np.nan))),
    ("rewards of 1", array("rewards", lambda r: r + 1)),
    ("dones of 1 at the start", array("dones", _set(0, 1))),
    ("contact modes of 7", array("contacts/mode", lambda m: np.full_like(m, 7))),
    ("contact bodies of 9", array("contacts/body_a", lambda b: np.full_like(b, 9))),
    ("contacts of the ground with itself", array("contacts/body_a", lambda b: np.full_like(b, -1))),
    ("contact normals of length 3", array("contacts/normal_world", lambda n: 3 * n)),
    ("contact impulses of NaN", array("contacts/impulse_world", lambda i: i * np.nan)),
    ("contact impulses that pull", array("contacts/impulse_world", lambda i: -i)),
    ("contact distances of 9 m", array("contacts/distance", lambda d: d + 9)),
    ("contact points 9 m away", array("contacts/pos_world", lambda p: p + 9)),
    ("offsets that fall", array("contacts/offsets", lambda o: o[::-1])),
    ("offsets beyond the contacts", array("contacts/offsets", lambda o: o + 5)),
    ("obs/object that disagrees", array("obs/object", lambda o: o + 0.1)),
    ("a parameter outside of its bounds", array("parameters/friction", lambda f: f + 100)),
    ("a parameter of NaN", array("parameters/friction", lambda f: f * np.nan)),
    ("a unit of mm", _attribute("bodies/pos", "unit", "mm")),
    ("no unit", shard(lambda file: file["data/demo_0/bodies/pos"].attrs.__delitem__("unit"))),
    ("a frame of the body", _attribute("bodies/pos", "frame", "body")),
    ("an order x y z w", _attribute("bodies/quat_wxyz", "order", "x y z w")),
    ("axes of another order", _attribute("bodies/pos", "shape_meaning", "(B, T, 3)")),
    ("num_samples of another length", _attribute("", "num_samples", 3)),
    ("an episode_index of another", _attribute("", "episode_index", 77)),
    ("params_json that is no JSON", _attribute("", "params_json", "{")),
    ("params_json that disagrees", _attribute("", "params_json", '{"friction": {"value": 9.0, "unit": "1"}}')),
    ("params_json of deep nesting", _attribute("", "params_json", DEEP[:60_000])),
    ("effects_json that names a file", _attribute("", "effects_json", '{"/tmp/x.py:X": {}}')),
    ("model_file that is no XML", _attribute("", "model_file", "<mujoco")),
    ("model_file that includes a file", _attribute("", "model_file", '<mujoco><include file="/etc/passwd"/></mujoco>')),
    ("a split that names no demo", _splits([b"demo_0", b"demo_99"])),
    ("a split that names a demo twice", _splits([b"demo_0", b"demo_0"])),
    ("a demo that is missing", shard(lambda file: file["data"].__delitem__("demo_1"))),
    ("a demo that is a link to another", shard(_linked)),
    ("an array that is missing", shard(lambda file: file["data/demo_0/bodies"].__delitem__("vel"))),
    ("an array of 10^12 zeros", shard(lambda file: _vast(file, "bodies/pos", (10**12, 1, 3)))),
    ("images of 10^12 pixels", shard(lambda file: _vast(file, "obs/view0_image", (8, 10**6, 10**6, 3)))),
    ("masks with a label of no body", array("obs/view0_mask", lambda m: np.where(m > 0, 9, m).astype(np.uint8))),
    ("depth of NaN", array("obs/view0_depth", lambda d: d * np.nan)),
    ("depth that is negative", array("obs/view0_depth", lambda d: -d)),
    ("depth in mm", array("obs/view0_depth", lambda d: 1000 * d)),
    ("an exposure of NaN", array("cameras/view0/gain_rgb", lambda g: g * np.nan)),
    ("a light of NaN", array("light/gain_rgb", lambda g: g * np.nan)),
    ("another format", shard(lambda file: file.attrs.__setitem__("format", "cgwm-rollouts/9"))),
    ("no format", shard(lambda file: file.attrs.__delitem__("format"))),
)


def _vast(file: h5py.File, at: str, shape: tuple[int, ...]) -> None:
    one = file[f"data/demo_0/{at}"]
    kind, attributes = one.dtype, dict(one.attrs)
    del file[f"data/demo_0/{at}"]
    chunks = tuple(min(64, size) for size in shape)
    made = file.create_dataset(f"data/demo_0/{at}", shape, kind, chunks=chunks)
    for key, value in attributes.items():
        made.attrs[key] = value


def _K(change: Any) -> Edit:
    return array("cameras/view0/K", change)


def _mirrored(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([-1.0, 1.0, 1.0, 1.0])


CAMERAS: tuple[tuple[str, Edit], ...] = (
    ("K of zeros", _K(np.zeros_like)),
    ("K of NaN", _K(lambda k: k * np.nan)),
    ("K with a negative focal length", _K(lambda k: k * np.array([[-1.0, 1, 1], [1, 1, 1], [1, 1, 1]]))),
    ("K with another last row", _K(_set((2, 2), 5.0))),
    ("a pose of zeros", array("cameras/view0/T_world_cam", np.zeros_like)),
    ("a pose of NaN", array("cameras/view0/T_world_cam", lambda T: T * np.nan)),
    (
        "a pose that is scaled",
        array("cameras/view0/T_world_cam", lambda T: T * np.array([[2.0] * 3 + [1.0]] * 3 + [[1.0] * 4])),
    ),
    ("a pose that is mirrored", array("cameras/view0/T_world_cam", _mirrored)),
    ("masks that are shifted", array("obs/view0_mask", lambda m: np.roll(m, 12, axis=2))),
    ("masks of another size", array("obs/view0_mask", lambda m: m[:, ::2, ::2])),
    ("images of another size", array("obs/view0_image", lambda i: i[:, ::2, ::2])),
    ("images of another type", array("obs/view0_image", lambda i: i.astype(np.float64))),
    ("one image less", array("obs/view0_image", lambda i: i[:-1])),
    ("a width of another image", array("cameras/view0/width", lambda w: w * 2)),
    ("distortion that is none", array("cameras/view0/dist", lambda d: np.array([np.nan] * 4))),
    ("depth of another size", array("obs/view0_depth", lambda d: d[:, ::2, ::2])),
)


def _truncated(root: Path) -> None:
    path = root / SHARD
    path.write_bytes(path.read_bytes()[:-5000])


def _flipped(root: Path) -> None:
    data = bytearray((root / SHARD).read_bytes())
    data[len(data) // 2] ^= 255
    (root / SHARD).write_bytes(bytes(data))


FILES: tuple[tuple[str, Edit], ...] = (
    ("a shard that is cut off", _truncated),
    ("a shard with a changed byte", _flipped),
    ("a shard that is missing", kind_of(SHARD, "removed")),
    ("a shard that is a named pipe", kind_of(SHARD, "fifo")),
    ("a shard that is a device", kind_of(SHARD, "/dev/zero")),
    ("a shard outside", field(FILE, "shards 0 file", '"../../x.h5"')),
    ("a shard twice", twice(FILE, "shards 0", "")),
    ("shard_count of 10^12", field(FILE, "shard_count", "1000000000000")),
    ("shard_count of 0", field(FILE, "shard_count", "0")),
    ("shard_count of true", field(FILE, "shard_count", "true")),
    ("rollouts of 10^12", field(FILE, "rollouts", "1000000000000")),
    ("rollouts that are negative", field(FILE, "rollouts", "-2")),
    ("rollouts of 5000 digits", field(FILE, "rollouts", DIGITS)),
    ("bytes that are a text", field(FILE, "shards 0 bytes", '"many"')),
    ("a key twice", twice(FILE, "rollouts", "2")),
    ("deep nesting", field(FILE, "notes", DEEP)),
    ("no shards' table", field(FILE, "shards", "null")),
    ("a manifest that is a named pipe", kind_of(FILE, "fifo")),
)
"""What neither `validate` nor `merge` may take."""

MANIFEST: tuple[tuple[str, Edit], ...] = (
    ("bodies of others", field(FILE, "bodies", '["mug"]')),
    ("cameras of others", field(FILE, "cameras", '["nothing"]')),
    ("a model outside", field(FILE, "model", '"../../model"')),
    ("another model's hash", field(FILE, "model_sha256", f'"{"0" * 64}"')),
)
