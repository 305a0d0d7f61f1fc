"""Labelled rollouts in HDF5: robomimic's skeleton plus the cameras, contacts and parameters that it lacks.

The bytes depend on the content alone (no times, no host names inside), so equal seeds give equal files. A demo is
named after the global index of its rollout, whatever the shard, so joining shards renames nothing.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import h5py
import numpy as np

from ..schemas import ROLLOUTS_FORMAT, InputDataError
from .cameras import Camera
from .guarded_file import GuardedFile

Compression = Literal["zstd", "gzip", "none"]

Node = Any
"""A group of an HDF5 file; h5py's own types do not tell what a path in it leads to."""

CHUNK_FRAMES = 8
"""Frames in a chunk of images: with zstd-1 the best of size, writing and random reading that was measured."""

ZSTD_FILTER = 32015
"""HDF5's registered number of the zstd filter, which hdf5plugin brings."""

SHARDS = "shards"
"""Group of an index: the files that it looks into (`file`, relative to it), with their `bytes` and `sha256`."""

VALID_EVERY = 5
"""Every n-th rollout (by global index, the last of each group) belongs to `mask/valid`, the others to `mask/train`."""

CONVENTION = (
    "SI units (m, kg, s, N, rad). World right-handed, z up. T_a_b maps coordinates of frame b to frame a. Cameras "
    "OpenCV: x right, y down, z forward; the top-left pixel's centre is (0.5, 0.5). Quaternions Hamilton, w x y z, "
    "T_world_body. Linear velocities are those of the body frame's origin in world axes; angular velocities are in "
    "body axes. Images uint8 RGB."
)


@dataclass(frozen=True)
class ContactTable:
    """The contacts of a rollout, frame after frame; N rows in all."""

    offsets: np.ndarray
    """Rows `offsets[t]:offsets[t + 1]` belong to frame t; shape (T + 1,), int64."""
    body_a: np.ndarray
    """Index into the bodies, shape (N,), int32."""
    body_b: np.ndarray
    """Index into the bodies, -1 = the ground; shape (N,), int32."""
    position_m: np.ndarray
    """Contact point, world frame [m], shape (N, 3)."""
    normal: np.ndarray
    """Unit normal from b to a, world frame [1], shape (N, 3)."""
    distance_m: np.ndarray
    """Signed distance [m], negative = penetration; shape (N,)."""
    impulse_n_s: np.ndarray
    """Impulse on body a since the frame before, world frame [N s], shape (N, 3)."""
    sliding: np.ndarray
    """1 where the friction is at its limit, 0 where it sticks; shape (N,), uint8."""


@dataclass(frozen=True)
class RolloutParameter:
    """A physical number of one rollout, and the fit's distribution that it was drawn from."""

    name: str
    unit: str
    value: float
    estimate: float
    std_error: float | None


@dataclass(frozen=True)
class RolloutLabels:
    """All of one rollout except its images. T frames, B bodies."""

    episode_index: int
    """Global index of the rollout."""
    seed: int
    """Root seed: the rollout is drawn from `numpy.random.SeedSequence(seed, spawn_key=(episode_index,))`."""
    model_mjcf: str
    time_s: np.ndarray
    states: np.ndarray
    """MuJoCo's state of `model_mjcf`: time, qpos, qvel; shape (T, D)."""
    actions: np.ndarray
    """Normalised commands in [-1, 1], shape (T, A)."""
    action_meaning: str
    bodies: tuple[str, ...]
    motions: tuple[str, ...]
    """free, driven or fixed, for each body."""
    mass_kg: np.ndarray
    """Shape (B,)."""
    com_m: np.ndarray
    """Centre of mass in the body frame [m], shape (B, 3)."""
    inertia_kg_m2: np.ndarray
    """xx yy zz xy xz yz about the centre of mass, body axes; shape (B, 6)."""
    position_m: np.ndarray
    quat_wxyz: np.ndarray
    velocity_m_s: np.ndarray
    omega_body_rad_s: np.ndarray
    gravity_m_s2: np.ndarray
    """World frame, shape (3,)."""
    contacts: ContactTable
    parameters: tuple[RolloutParameter, ...] = ()
    effects: Mapping[str, Mapping[str, float]] | None = None
    cameras: Mapping[str, Camera] | None = None


@dataclass(frozen=True)
class FrameBlock:
    """Successive labelled images of one camera; n <= CHUNK_FRAMES frames."""

    camera: str
    start: int
    image: np.ndarray
    """uint8 RGB, shape (n, H, W, 3)."""
    depth: np.ndarray
    """float32 [m] along the optical axis, 0 = no surface; shape (n, H, W)."""
    mask: np.ndarray
    """uint8: 0 background, k the k-th body; shape (n, H, W)."""


def filter_options(compression: Compression) -> dict[str, Any]:
    """Return h5py's dataset options for a compression.

    Raises:
        InputDataError: If zstd is asked for and hdf5plugin is not installed.
    """
    if compression == "none":
        return {}
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 4}
    _require_zstd("writing with compression zstd")
    import hdf5plugin

    return dict(hdf5plugin.Zstd(clevel=1))


def _require_zstd(what: str) -> None:
    try:
        import hdf5plugin  # noqa: F401  (registers the filter when it is imported)
    except ImportError:
        pass
    if not h5py.h5z.filter_avail(ZSTD_FILTER):
        raise InputDataError(
            f"{what} needs the HDF5 filter zstd, which is not installed here.",
            "files written with --compression gzip or none need no plugin.",
            "pip install hdf5plugin",
        )


def open_shard(path: Path, cache_bytes: int = 16 << 20) -> h5py.File:
    """Open a shard, or the index of several, for reading.

    Args:
        path: An HDF5 file of rollouts.
        cache_bytes: Chunk cache of a dataset; at least one chunk, or random access decodes each chunk again.

    Raises:
        InputDataError: If it is missing, damaged, no file of rollouts, or needs a filter that is not there.
    """
    if not path.is_file():
        raise InputDataError(f"{path}: no such file.")
    try:
        file = h5py.File(path, "r", rdcc_nbytes=cache_bytes)
    except OSError as error:
        raise InputDataError(f"{path}: not a readable HDF5 file: {str(error).splitlines()[0]}.") from None
    try:
        if file.attrs.get("format") != ROLLOUTS_FORMAT:
            found = file.attrs.get("format", "none")
            raise InputDataError(f"{path}: its format attribute is '{found}'.", f"'{ROLLOUTS_FORMAT}'.")
        if "zstd" in str(file.attrs.get("filters", "")):
            _require_zstd(f"reading {path}")
        if SHARDS in file:
            _refuse_lost(path, file[SHARDS])
    except BaseException:
        file.close()
        raise
    return file


def _refuse_lost(path: Path, shards: Node) -> None:
    """Refuse an index whose shards are not all there: HDF5 would read fill values, and say nothing."""
    for name, size in zip(shards["file"][()], shards["bytes"][()], strict=True):
        shard = path.resolve().parent / name.decode()
        if not shard.is_file() or shard.stat().st_size != size:
            found = f"{shard.stat().st_size} bytes" if shard.is_file() else "no such file"
            raise InputDataError(
                f"{path}: an index that looks into {name.decode()}: {found}.",
                f"a shard of {size} bytes there.",
                "put the shard back, or make the index again with 'cgwm merge --overwrite'.",
            )


def demo_names(file: h5py.File) -> list[str]:
    """Return the names of the demos of a shard, by rollout index."""
    data: Node = file["data"]
    return sorted(data, key=lambda name: int(name.removeprefix("demo_")))


class RolloutWriter:
    """Writes rollouts into one HDF5 file, one after the other, holding no more than the block it is given.

    The path is written to directly: give the temporary path of :func:`datasets.atomic.new_file` or `new_directory`.

    Args:
        path: The file to write.
        seed: Root seed.
        config_json: The resolved settings.
        creator: Program and version.
        compression: Filter of images, depth and masks.
    """

    def __init__(self, path: Path, seed: int, config_json: str, creator: str, compression: Compression = "zstd"):
        self._options = filter_options(compression)
        self._guarded = GuardedFile(path)
        self._file = h5py.File(self._guarded, "w")
        self._file.attrs.update(
            format=ROLLOUTS_FORMAT,
            format_version=1,
            creator=creator,
            seed=seed,
            config_json=config_json,
            convention=CONVENTION,
            filters=compression,
        )
        self._data: Node = self._file.create_group("data")
        env = {"env_name": "cgwm", "env_type": 2, "type": 2, "env_kwargs": {}}
        self._data.attrs["env_args"] = json.dumps(env)
        self._indices: list[int] = []
        self.total = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            try:
                self._file.close()
            finally:
                self._guarded.close()
                if kind is None or issubclass(kind, Exception):
                    self._check()  # what went wrong first; the others follow from it

    def write(self, labels: RolloutLabels, frames: Iterable[FrameBlock] = ()) -> None:
        """Write one rollout; `frames` may be a generator, and is consumed block by block."""
        demo = self._data.create_group(f"demo_{labels.episode_index}")
        count = len(labels.time_s)
        _write_attributes(demo, labels, count)
        _write_timeline(demo, labels)
        _write_bodies(demo, labels)
        _write_contacts(demo, labels.contacts)
        _write_parameters(demo, labels.parameters)
        observations = demo.create_group("obs")
        _write_object_observation(observations, labels)
        if labels.cameras:
            _write_cameras(demo, labels.cameras)
            images = {name: self._image_sets(observations, name, c, count) for name, c in labels.cameras.items()}
            visible = _write_frames(images, frames, count, len(labels.bodies))
            axes, text = "(T, camera, body)", "Pixels of the body in the mask; cameras in the order of their names."
            cameras = sorted(labels.cameras)
            pixels = np.stack([visible[name] for name in cameras], axis=1)
            _put(demo["bodies"], "visible_px", pixels, "px", "image", "-", axes, text)
        _link_next_observations(demo)
        self._check()
        self._indices.append(labels.episode_index)
        self.total += count

    def _check(self) -> None:
        if self._guarded.error is not None:
            raise self._guarded.error

    def _image_sets(self, group: Node, name: str, camera: Camera, count: int) -> dict[str, h5py.Dataset]:
        size = (camera.height, camera.width)
        texts = {
            "image": ("1", "row, column, RGB", "(T, H, W, 3)", "Rendered colour, 0 to 255."),
            "depth": (
                "m",
                "row, column",
                "(T, H, W)",
                "Depth along the optical axis of what the mask names; 0 = no surface.",
            ),
            "mask": ("1", "row, column", "(T, H, W)", "Visible instance: 0 = background, k = the k-th body."),
        }
        kinds = {"image": (np.uint8, (*size, 3)), "depth": (np.float32, size), "mask": (np.uint8, size)}
        made: dict[str, h5py.Dataset] = {}
        for key, (dtype, shape) in kinds.items():
            chunk = (min(CHUNK_FRAMES, count), *shape)
            sets = group.create_dataset(
                f"{name}_{key}", shape=(count, *shape), dtype=dtype, chunks=chunk, **self._options
            )
            unit, order, axes, text = texts[key]
            _describe(sets, unit, f"image of camera {name}", order, axes, text)
            made[key] = sets
        return made

    def _finish(self) -> None:
        self._data.attrs["total"] = self.total
        splits = {"train": [], "valid": []}
        for index in sorted(self._indices):
            splits["valid" if index % VALID_EVERY == VALID_EVERY - 1 else "train"].append(f"demo_{index}")
        group = self._file.create_group("mask")
        for split, names in splits.items():
            width = max((len(name) for name in names), default=1)
            group.create_dataset(split, data=np.array(names, dtype=f"S{width}"))


def _put(group: Node, name: str, data: Any, unit: str, frame: str, order: str, shape: str, text: str) -> h5py.Dataset:
    values = np.asarray(data)
    checked = {"fletcher32": True, "chunks": values.shape} if values.ndim and values.size else {}
    made = group.create_dataset(name, data=values, **checked)
    _describe(made, unit, frame, order, shape, text)
    return made


def _describe(made: h5py.Dataset, unit: str, frame: str, order: str, shape: str, text: str) -> None:
    made.attrs.update(unit=unit, frame=frame, order=order, shape_meaning=shape, description=text)


def _write_attributes(demo: Node, labels: RolloutLabels, count: int) -> None:
    parameters = {p.name: {"value": p.value, "unit": p.unit} for p in labels.parameters}
    demo.attrs.update(
        num_samples=count,
        model_file=labels.model_mjcf,
        episode_index=labels.episode_index,
        seed=labels.seed,
        params_json=json.dumps(parameters),
        effects_json=json.dumps({name: dict(values) for name, values in (labels.effects or {}).items()}),
    )


def _write_timeline(demo: Node, labels: RolloutLabels) -> None:
    count = len(labels.time_s)
    done = np.zeros(count, np.uint8)
    done[-1] = 1
    state_text = "MuJoCo's state of the attribute model_file (free bodies; velocities linear world, angular body)."
    _put(demo, "time", labels.time_s, "s", "-", "-", "(T,)", "Time since the rollout's start.")
    _put(demo, "states", labels.states, "SI", "world", "time, qpos, qvel; quaternions w x y z", "(T, D)", state_text)
    _put(demo, "actions", labels.actions, "1", "world", "x y z a driven body", "(T, A)", labels.action_meaning)
    _put(demo, "rewards", np.zeros(count), "1", "-", "-", "(T,)", "No task is defined: zero.")
    _put(demo, "dones", done, "1", "-", "-", "(T,)", "1 at the last frame.")


def _write_bodies(demo: Node, labels: RolloutLabels) -> None:
    group = demo.create_group("bodies")
    names = np.array([name.encode() for name in labels.bodies])
    motions = np.array([motion.encode() for motion in labels.motions])
    inertia_text = "About the centre of mass, body axes."
    _put(group, "names", names, "-", "-", "-", "(B,)", "Body k has the value k + 1 in the masks.")
    _put(group, "motions", motions, "-", "-", "-", "(B,)", "free, driven (its track is a command) or fixed.")
    _put(group, "pos", labels.position_m, "m", "world", "x y z", "(T, B, 3)", "Origin of the body frame.")
    _put(group, "quat_wxyz", labels.quat_wxyz, "1", "world", "w x y z", "(T, B, 4)", "Rotation of T_world_body.")
    _put(group, "vel", labels.velocity_m_s, "m/s", "world", "x y z", "(T, B, 3)", "Velocity of the body origin.")
    _put(group, "omega_body", labels.omega_body_rad_s, "rad/s", "body", "x y z", "(T, B, 3)", "Angular velocity.")
    _put(group, "mass", labels.mass_kg, "kg", "-", "-", "(B,)", "Mass in this rollout.")
    _put(group, "com", labels.com_m, "m", "body", "x y z", "(B, 3)", "Centre of mass in the body frame.")
    _put(group, "inertia", labels.inertia_kg_m2, "kg m2", "body", "xx yy zz xy xz yz", "(B, 6)", inertia_text)
    _put(group, "gravity", labels.gravity_m_s2, "m/s2", "world", "x y z", "(3,)", "Gravitational acceleration.")


def _write_contacts(demo: Node, table: ContactTable) -> None:
    group = demo.create_group("contacts")
    impulse = "Impulse on body a since the frame before (frame 0: zero); body b gets its opposite."
    force = "Mean force on body a since the frame before: impulse / frame interval = impulse * rate."
    offsets = "Rows offsets[t]:offsets[t + 1] of the other arrays belong to frame t."
    mode = "0 = sticking, 1 = sliding (friction at its limit)."
    _put(group, "offsets", table.offsets, "1", "-", "-", "(T + 1,)", offsets)
    _put(group, "body_a", table.body_a, "1", "-", "-", "(N,)", "Index into bodies/names.")
    _put(group, "body_b", table.body_b, "1", "-", "-", "(N,)", "Index into bodies/names; -1 = the ground.")
    _put(group, "pos_world", table.position_m, "m", "world", "x y z", "(N, 3)", "Contact point.")
    _put(group, "normal_world", table.normal, "1", "world", "x y z", "(N, 3)", "Unit normal from b to a.")
    _put(group, "distance", table.distance_m, "m", "-", "-", "(N,)", "Signed distance; negative = penetration.")
    _put(group, "impulse_world", table.impulse_n_s, "N s", "world", "x y z", "(N, 3)", impulse)
    _put(group, "mode", table.sliding, "1", "-", "-", "(N,)", mode)
    group.attrs["force"] = force


def _write_parameters(demo: Node, parameters: tuple[RolloutParameter, ...]) -> None:
    group = demo.create_group("parameters")
    for p in parameters:
        made = _put(group, p.name, np.float64(p.value), p.unit, "-", "-", "scalar", "Value used in this rollout.")
        made.attrs["estimate"] = p.estimate
        if p.std_error is not None:
            made.attrs["std_error"] = p.std_error


def _write_object_observation(group: Node, labels: RolloutLabels) -> None:
    parts = (labels.position_m, labels.quat_wxyz, labels.velocity_m_s, labels.omega_body_rad_s)
    values = np.concatenate(parts, axis=-1).reshape(len(labels.time_s), -1)
    order = "for each body: position, quaternion w x y z, velocity (world), angular velocity (body)"
    _put(group, "object", values, "SI", "world", order, "(T, 13 B)", "State of all bodies, robomimic's low-dim key.")


def _write_cameras(demo: Node, cameras: Mapping[str, Camera]) -> None:
    group = demo.create_group("cameras")
    for name, camera in cameras.items():
        entry = group.create_group(name)
        distortion = np.asarray(camera.distortion, float)
        text = "Camera to world; OpenCV axes (x right, y down, z forward)."
        _put(entry, "K", camera.K, "px", "image", "row", "(3, 3)", "Intrinsics; top-left pixel centre (0.5, 0.5).")
        _put(entry, "dist", distortion, "1", "-", "k1 k2 p1 p2 k3", "(k,)", "OpenCV distortion; empty: none.")
        _put(entry, "T_world_cam", camera.T_world_cam, "m", "world", "row", "(4, 4)", text)
        _put(entry, "width", camera.width, "px", "-", "-", "scalar", "Image width.")
        _put(entry, "height", camera.height, "px", "-", "-", "scalar", "Image height.")
        entry.attrs["camera_model"] = "OPENCV" if distortion.any() else "PINHOLE"


def _write_frames(
    images: Mapping[str, Mapping[str, h5py.Dataset]], frames: Iterable[FrameBlock], count: int, body_count: int
) -> dict[str, np.ndarray]:
    """Write the blocks, and return the visible pixels of each body by camera, shape (T, B), int32."""
    visible = {name: np.full((count, body_count), -1, np.int32) for name in images}
    for block in frames:
        stop = block.start + len(block.image)
        for key in ("image", "depth", "mask"):
            images[block.camera][key][block.start : stop] = getattr(block, key)
        for offset, mask in enumerate(block.mask):
            pixels = np.bincount(mask.ravel(), minlength=body_count + 1)
            visible[block.camera][block.start + offset] = pixels[1 : body_count + 1]
    for name, pixels in visible.items():
        if (pixels < 0).any():
            raise ValueError(f"camera {name}: {int((pixels[:, 0] < 0).sum())} of {count} frames were not written")
    return visible


def _link_next_observations(demo: Node) -> None:
    """Add `next_obs` as virtual datasets on `obs`, shifted by one frame: what robomimic reads, at no size."""
    group = demo.create_group("next_obs")
    for name, source in demo["obs"].items():
        count = source.shape[0]
        # By h5py's low level: its high level stamps virtual datasets with the time of their creation.
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_obj_track_times(False)
        properties.set_layout(h5py.h5d.VIRTUAL)
        for target, start, length in ((0, 1, count - 1), (count - 1, count - 1, 1)):
            if length > 0:
                spaces = [_frames_space(source.shape, first, length) for first in (target, start)]
                properties.set_virtual(spaces[0], b".", source.name.encode(), spaces[1])
        space = h5py.h5s.create_simple(source.shape)
        made = h5py.h5d.create(group.id, name.encode(), source.id.get_type(), space, properties)
        h5py.Dataset(made).attrs["description"] = f"obs/{name} one frame later; the last frame is repeated."


def _frames_space(shape: tuple[int, ...], first: int, length: int) -> h5py.h5s.SpaceID:
    space = h5py.h5s.create_simple(shape)
    space.select_hyperslab((first, *(0 for _ in shape[1:])), (length, *shape[1:]))
    return space
