"""Labelled rollouts in HDF5: robomimic's structure plus the cameras, contacts and parameters that it lacks.

The bytes depend only on the content (without times and host names), so equal seeds give equal files. A demo is named
after the global index of its rollout, whatever the shard, so joining shards renames nothing.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np

from ...schemas import ROLLOUTS_FORMAT, Exposure, InputDataError, Light
from ...schemas.regular_files import real_path, require_regular_file
from ..capture.cameras import Camera
from ..io.hdf5_files import hdf5_faults, is_own_link, open_hdf5, own_objects, require_stored
from .chunks import require_zstd

Node = Any
"""A group of an HDF5 file; h5py's types do not specify what a path in it leads to."""

SHARDS = "shards"
"""Group of an index with the files that it refers to (`file`, relative to it), with their `bytes` and `sha256`."""

SHARD = re.compile(r"rollouts-(\d{4,})-of-(\d{4,})\.h5")
"""Name of the file of a shard."""

VALID_EVERY = 5
"""Every n-th rollout (by global index, the last of each group) belongs to `mask/valid`, the others to `mask/train`."""

CONVENTION = (
    "SI units (m, kg, s, N, rad). World right-handed, z up. T_a_b maps coordinates of frame b to frame a. Cameras "
    "OpenCV: x right, y down, z forward; the top-left pixel's centre is (0.5, 0.5). Quaternions Hamilton, w x y z, "
    "T_world_body. Linear velocities are those of the body frame's origin in world axes; angular velocities are in "
    "body axes. Images uint8 RGB."
)


@dataclass(frozen=True, kw_only=True)
class ContactTable:
    """The contacts of a rollout, ordered by frame; N rows in total."""

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


@dataclass(frozen=True, kw_only=True)
class RolloutParameter:
    """A physical parameter of one rollout, and the fitted distribution that it was drawn from."""

    name: str
    """Name of the parameter."""
    unit: str
    """Its unit."""
    value: float
    """Value in this rollout."""
    estimate: float
    """Estimate of the fit."""
    std_error: float | None
    """Standard error of the fit; None if there is none."""


@dataclass(frozen=True, kw_only=True)
class JointTable:
    """The joints of a rollout of T frames; J joints that move."""

    names: tuple[str, ...]
    """Their names."""
    links: tuple[str, ...]
    """The bodies that they carry."""
    kinds: tuple[str, ...]
    """hinge or slide."""
    values: np.ndarray
    """Values [rad or m], shape (T, J)."""
    speeds: np.ndarray
    """Rates [rad/s or m/s], shape (T, J)."""


@dataclass(frozen=True, kw_only=True)
class RolloutLabels:
    """Everything of one rollout of T frames and B bodies except its images."""

    episode_index: int
    """Global index of the rollout."""
    seed: int
    """Root seed: the rollout is drawn from `numpy.random.SeedSequence(seed, spawn_key=(episode_index,))`."""
    model_mjcf: str
    """MJCF text of the model with the parameters of this rollout."""
    time_s: np.ndarray
    """Times of the frames [s], shape (T,)."""
    states: np.ndarray
    """MuJoCo's state of `model_mjcf`: time, qpos, qvel; shape (T, D)."""
    actions: np.ndarray
    """Normalised commands in [-1, 1], shape (T, A)."""
    action_meaning: str
    """Meaning of the actions, in words."""
    bodies: tuple[str, ...]
    """Names of the bodies."""
    motions: tuple[str, ...]
    """free, driven, fixed or link, for each body."""
    mass_kg: np.ndarray
    """Masses [kg], shape (B,)."""
    com_m: np.ndarray
    """Centre of mass in the body frame [m], shape (B, 3)."""
    inertia_kg_m2: np.ndarray
    """Inertia xx yy zz xy xz yz about the centre of mass [kg m2], body axes, shape (B, 6)."""
    position_m: np.ndarray
    """Body frame origins [m], world frame, shape (T, B, 3)."""
    quat_wxyz: np.ndarray
    """Orientations T_world_body, shape (T, B, 4)."""
    velocity_m_s: np.ndarray
    """Velocities of the origins [m/s], world axes, shape (T, B, 3)."""
    omega_body_rad_s: np.ndarray
    """Angular velocities [rad/s], body axes, shape (T, B, 3)."""
    gravity_m_s2: np.ndarray
    """Gravity [m/s2], world frame, shape (3,)."""
    contacts: ContactTable
    """The contacts of all frames."""
    contact_force_n: np.ndarray
    """Mean force of all contacts on each body since the frame before [N], world frame, (T, B, 3); 0 at frame 0."""
    contact_torque_n_m: np.ndarray
    """Mean torque on each free body about its centre of mass since the frame before [N m], world frame, (T, B, 3)."""
    parameters: tuple[RolloutParameter, ...] = ()
    """The physical parameters of this rollout."""
    effects: Mapping[str, Mapping[str, float]] | None = None
    """Parameters of the active effects, by effect; None without effects."""
    cameras: Mapping[str, Camera] | None = None
    """Cameras by name; None without images."""
    attempt: int = 0
    """Number of rejected earlier draws of this rollout; from 1 on the spawn key is (episode_index, attempt)."""
    exposures: Mapping[str, Exposure] | None = None
    """Exposure of each camera; None: that of the model."""
    light_gain_rgb: np.ndarray | None = None
    """Brightness of the light relative to the photos [1], shape (3,)."""
    light: Light | None = None
    """Lamp and sky of this rollout, if the model has them."""
    materials: tuple[str | None, ...] | None = None
    """Material of each body; None where no body has one."""
    joints: JointTable | None = None
    """The joints of jointed bodies; None without any."""


@dataclass(frozen=True)
class FrameBlock:
    """Labelled images of n <= CHUNK_FRAMES successive frames of one camera."""

    camera: str
    """Name of the camera."""
    start: int
    """First frame."""
    image: np.ndarray
    """Colour images, uint8 RGB, shape (n, H, W, 3)."""
    depth: np.ndarray
    """Depth along the optical axis [m], float32, 0 = no surface; shape (n, H, W)."""
    mask: np.ndarray
    """Labels, uint8: 0 background, k the k-th body; shape (n, H, W)."""
    amodal: np.ndarray
    """Amodal masks in the smallest unsigned type with a bit for each body, shape (n, H, W): bit k - 1 is set where the
    k-th body is visible or would be without occlusion."""
    visible_px: np.ndarray
    """Number of pixels of each body in the mask, int32, shape (n, B)."""
    amodal_px: np.ndarray
    """Number of pixels of each body in its amodal mask, int32, shape (n, B)."""
    ready: Callable[[], None] | None = None
    """Function that waits for the device that fills the arrays, to be called before reading them; None: not needed."""

    @property
    def images(self) -> dict[str, np.ndarray]:
        """The arrays of images, by the ending of their name in the file."""
        return {"image": self.image, "depth": self.depth, "mask": self.mask, "amodal": self.amodal}


DEMO = re.compile(r"demo_(0|[1-9][0-9]{0,17})")
"""Name of a rollout's group, with its global index."""
MOST_BODIES = 64
"""Maximum number of bodies, because an amodal mask has a bit for each."""


def amodal_dtype(bodies: int) -> np.dtype[Any]:
    """Return the smallest unsigned type with a bit for each body.

    Raises:
        InputDataError: If there are more bodies than bits.
    """
    for dtype in (np.uint8, np.uint16, np.uint32, np.uint64):
        if bodies <= 8 * np.dtype(dtype).itemsize:
            return np.dtype(dtype)
    raise InputDataError(
        f"{bodies} bodies: their amodal masks have a bit for each.",
        f"up to {MOST_BODIES} bodies.",
        todo="synthesize fewer bodies in one scene.",
    )


def open_shard(path: Path, cache_bytes: int = 16 << 20) -> h5py.File:
    """Open a shard, or the index of several, for reading.

    Args:
        path: An HDF5 file of rollouts.
        cache_bytes: Chunk cache of a dataset; at least one chunk, or random access decodes each chunk again.

    Raises:
        InputDataError: If it is missing, damaged, not a file of rollouts, refers to other files than shards, or needs a
            missing filter.
    """
    file = open_hdf5(path, rdcc_nbytes=cache_bytes)
    try:
        with hdf5_faults(path):
            found = file.attrs.get("format", "none")
            if not isinstance(found, str) or found != ROLLOUTS_FORMAT:
                raise InputDataError(
                    f"{path}: its format attribute is '{found!s:.80}'.",
                    f"'{ROLLOUTS_FORMAT}'.",
                    "name a file that 'cgwm synthesize' wrote.",
                )
            if "zstd" in str(file.attrs.get("filters", "")):
                require_zstd(f"reading {path}")
            root: Node = file
            for name in root:
                is_own_link(file, name, f"{path}: {name}")
            if SHARDS in file:
                _refuse_lost(path, file[SHARDS])
    except BaseException:
        file.close()
        raise
    return file


def _refuse_lost(path: Path, shards: Node) -> None:
    """Refuse an index with missing shards, for which HDF5 would silently read fill values."""
    for place, item in own_objects(shards, f"{path}: {SHARDS}"):
        if isinstance(item, h5py.Dataset):
            require_stored(item, f"{path}: {SHARDS}/{place}")
    for name, size in zip(_shard_files(path, shards), shards["bytes"][()].tolist(), strict=True):
        shard = real_path(path).parent / name
        there = os.path.lexists(shard) and require_regular_file(shard).stat().st_size
        if there != size:
            raise InputDataError(
                f"{path}: an index that looks into {name}: {f'{there} bytes' if there else 'no such file'}.",
                f"a shard of {size} bytes there.",
                "put the shard back, or make the index again with 'cgwm merge --overwrite'.",
            )


def _shard_files(path: Path, shards: Node) -> list[str]:
    """Return the files that an index looks into, relative to it; all must have the names of shards."""
    names = [name.decode() for name in shards["file"][()].tolist()]
    strange = next((name for name in names if not SHARD.fullmatch(PurePosixPath(name).name)), None)
    if strange is not None:
        raise InputDataError(
            f"{path}: an index that looks into {strange!a:.80}.",
            "rollouts-<i>-of-<n>.h5.",
            todo="copy the whole dataset, or run 'cgwm validate' on it.",
        )
    return names


def demo_names(file: h5py.File) -> list[str]:
    """Return the names of the demos of a shard, by rollout index.

    Raises:
        InputDataError: If something else is among them.
    """
    path = Path(file.filename)
    with hdf5_faults(path):
        data: Node = file["data"]
        for name in data:
            where = f"{path}: data/{name!a:.80}"
            if not DEMO.fullmatch(name) or not is_own_link(data, name, where):
                raise InputDataError(
                    f"{where}: no rollout.", "groups demo_<index> in data.", "name a file that 'cgwm synthesize' wrote."
                )
        return sorted(data, key=lambda name: int(name.removeprefix("demo_")))


def demo_of(file: h5py.File, name: str) -> Node:
    """Return the group of a rollout of a shard or of an index, after a look at what it declares.

    Raises:
        InputDataError: As :func:`stored_demo`, or if it has another number of frames than it says, or images of another
            size than that of their camera.
    """
    demo, path = stored_demo(file, name), Path(file.filename)
    with hdf5_faults(path):
        _require_sizes(demo, path, name)
    return demo


def stored_demo(file: h5py.File, name: str) -> Node:
    """Return the group of a rollout of a shard or of an index, of which all numbers are stored there.

    Raises:
        InputDataError: If it refers to files that are no shards of the dataset, or declares numbers that are not
            stored; or if it is damaged.
    """
    path = Path(file.filename)
    with hdf5_faults(path):
        data: Node = file["data"]
        demo: Node = data[name]
        if not hasattr(demo, "items"):
            raise InputDataError(
                f"{path}: data/{name}: no rollout.",
                "groups demo_<index> in data.",
                "name a file that 'cgwm synthesize' wrote.",
            )
        where = f"{path}: data/{name}"
        with ExitStack() as stack:

            @cache
            def opened(shard: str) -> h5py.File:
                return stack.enter_context(open_hdf5(real_path(path).parent / shard))

            shards = _shard_files(path, file[SHARDS]) if SHARDS in file else ()
            files = {shard: partial(opened, shard) for shard in shards}
            for place, item in own_objects(demo, where):
                if isinstance(item, h5py.Dataset):
                    require_stored(item, f"{where}/{place}", files)
        return demo


def _require_sizes(demo: Node, path: Path, name: str) -> None:
    frames, count = demo["time"].shape, demo.attrs["num_samples"]
    if not isinstance(count, int | np.integer) or frames != (count,):
        where = f"{path}: data/{name}/time"
        raise InputDataError(
            f"{where}: shape {frames}; num_samples says {count!s:.40}.",
            "as many frames.",
            todo="copy the file again, or run 'cgwm validate' on the dataset.",
        )
    for camera, entry in demo["cameras"].items() if "cameras" in demo else ():
        _require_pictures(demo, camera, tuple(int(entry[key][()]) for key in ("height", "width")), f"{path}, {name}")


def _require_pictures(demo: Node, camera: str, size: tuple[int, ...], where: str) -> None:
    """Refuse arrays of pictures of another size than that of their camera."""
    for kind in ("image", "depth", "mask", "amodal"):
        item = demo.get(f"obs/{camera}_{kind}")
        if item is not None and item.attrs.get("encoding") != "jpeg" and item.shape[1:3] != size:
            axes = "(T, H, W, 3)" if kind == "image" else "(T, H, W)"
            wanted = (item.shape[0], *size, *item.shape[3:])
            raise InputDataError(
                f"{where}: obs/{camera}_{kind}: its shape is {item.shape}; {axes} is documented, here {wanted}.",
                "images of the size of their camera.",
                todo="copy the file again, or run 'cgwm validate' on the dataset.",
            )
