"""Adapter of pycolmap: features and matches of photos, repeatable bit for bit.

Every seed is set and extraction, matching and mapping run on one thread each: with automatic thread counts two runs
on the same photos differ. Photos and pairs do not depend on each other, so that groups of them run side by side, each
as it would alone: photos in threads, pairs in processes. pycolmap is released often with renamed functions, so only
this module, `match_pairs` and `mapping` import it.
"""

from __future__ import annotations

import shutil
import signal
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap

from ....datasets.io.processors import processors
from ....datasets.io.progress import progress
from ..reconstruction import VerifiedPair
from ..turntable.features import standing_features
from .match_pairs import match_apart, match_pairs

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")

_EXTRACTION_CHUNK = 4
_MATCHING_BLOCK = 25
_COPIES = 8
"""Maximum number of copies of the database, which for hundreds of photos has hundreds of megabytes."""
_POLL_S = 0.2

pycolmap.logging.minloglevel = 3  # COLMAP's log would drown ours; its results are read from the database


def _keep_sigterm() -> None:
    """Restore Python's handler of SIGTERM: the import of COLMAP replaces it by one that exits without a clean-up."""
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


_keep_sigterm()


@dataclass(frozen=True)
class SfmImage:
    """An image to register."""

    name: str
    """Path relative to the image root, with forward slashes."""
    camera: str
    """Name of the camera; images of one camera share their intrinsics and their size."""
    mask: Path | None = None
    """Folder of masks, `<name>.png`, 0 where features are excluded; None uses the whole images."""
    stands: bool = False
    """Whether the camera stands in all images, so that features at one place in many of them are of its surroundings
    and are dropped."""


@dataclass(frozen=True, kw_only=True)
class SfmSettings:
    """Settings of one attempt."""

    seed: int = 0
    """Seed of matching and mapping."""
    max_features: int = 4096
    """Maximum number of features per image."""
    max_image_size: int = 1600
    """Maximum longer side of the reduced images [px]; keypoints are given in original pixels."""
    peak_threshold: float = 0.0067
    """Minimum contrast of a SIFT feature; lower for weak texture."""
    guided_matching: bool = False
    """Match again along the epipolar lines of the first verification."""
    max_ratio: float = 0.8
    """Maximum ratio of nearest to second-nearest descriptor distance; lower for repeated texture."""

    verification_trials: int = 2000
    """Maximum number of hypotheses per pair. Pairs without true matches use them all and take most of the time: on 20
    photos of a small scene 2000 kept 4848 inliers of the 4849 that COLMAP's 10000 find, in half the time."""

    @property
    def features(self) -> tuple[int, int, float]:
        """The settings that determine the features."""
        return self.max_features, self.max_image_size, self.peak_threshold

    @property
    def matches(self) -> tuple[object, ...]:
        """The settings that determine the verified matches; the mapping depends on the seed as well."""
        return (*self.features, self.guided_matching, self.max_ratio, self.verification_trials)


def versions() -> dict[str, str]:
    """Return the versions of the libraries that determine the result."""
    return {"pycolmap": pycolmap.__version__}


def build_database(database: Path, root: Path, images: Sequence[SfmImage], settings: SfmSettings) -> None:
    """Extract and match the features of all images into a new COLMAP database.

    Args:
        database: The file to create.
        root: Folder of the images.
        images: The images.
        settings: Settings of the attempt.
    """
    _extract(database, root, images, settings)
    if any(image.stands for image in images):
        _drop_standing(database)
    _match(database, [image.name for image in images], settings)


def read_pairs(database: Path) -> list[VerifiedPair]:
    """Return the verified pairs of a database, in the order of their identifiers."""
    opened = pycolmap.Database.open(database)
    try:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        keypoints = {image_id: opened.read_keypoints(image_id)[:, :2].astype(float) for image_id in names}
        identifiers, geometries = opened.read_two_view_geometries()
        pairs = []
        for pair_id, geometry in sorted(zip(identifiers, geometries, strict=True), key=lambda item: item[0]):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
            if len(matches):
                pairs.append(VerifiedPair(names[a], names[b], keypoints[a][matches[:, 0]], keypoints[b][matches[:, 1]]))
        return pairs
    finally:
        opened.close()


def feature_counts(database: Path) -> dict[str, int]:
    """Return the number of features of each image that COLMAP could read."""
    return count(
        database,
        lambda opened: {
            image.name: int(opened.num_keypoints_for_image(image.image_id)) for image in opened.read_all_images()
        },
    )


def exif_focals_px(database: Path) -> dict[str, float]:
    """Return the focal length [px] of each camera whose first photo has one in its EXIF data.

    COLMAP takes it from the 35 mm equivalent, from the resolution of the sensor, or from its list of cameras. To be
    read before a mapping, which writes its own cameras.
    """
    names = camera_names(database)
    cameras = count(database, lambda opened: opened.read_all_cameras())
    return {
        names[camera.camera_id]: float(camera.mean_focal_length())
        for camera in cameras
        if camera.has_prior_focal_length
    }


def _extract(database: Path, root: Path, images: Sequence[SfmImage], settings: SfmSettings) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.max_image_size = settings.max_image_size
    options.sift.max_num_features = settings.max_features
    options.sift.peak_threshold = settings.peak_threshold
    pycolmap.Database.open(database).close()
    for group in _groups(images):
        # before their features, so that the numbers of the images do not depend on who is done first
        pycolmap.import_images(
            database_path=database,
            image_path=root,
            image_names=[image.name for image in group],
            camera_mode=pycolmap.CameraMode.SINGLE,
            options=_reader(group, -1),
        )
    chunks = [chunk for group in _groups(images) for chunk in _chunks(group, _EXTRACTION_CHUNK)]

    def work(place: Path, chunk: Sequence[SfmImage], token: Any) -> None:
        pycolmap.extract_features(
            database_path=place,
            image_path=root,
            image_names=[image.name for image in chunk],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=_reader(chunk, _existing_camera(place, chunk[0].name)),
            extraction_options=options,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )
        bar.update(len(chunk))

    with progress(range(len(images)), "features", total=len(images), unit="image") as bar:
        _shared_out(database, settings.seed, chunks, work, ("keypoints", "descriptors"))
    _name_cameras(database, images)


def _reader(images: Sequence[SfmImage], camera: int) -> pycolmap.ImageReaderOptions:
    """Return options with which images of one camera are read; its number, -1 where it is new."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_PINHOLE"  # features and matches do not depend on it
    reader.existing_camera_id = camera
    if images[0].mask is not None:
        reader.mask_path = images[0].mask
    return reader


def _drop_standing(database: Path) -> None:
    """Drop the features that are at the same place in many images, which a standing camera sees of its surroundings."""
    opened = pycolmap.Database.open(database)
    try:
        identifiers = [image.image_id for image in opened.read_all_images()]
        keypoints = {key: opened.read_keypoints(key) for key in identifiers}
        described = {key: opened.read_descriptors(key) for key in identifiers}
        kept = [
            ~standing
            for standing in standing_features(
                [keypoints[key][:, :2] for key in identifiers], [described[key].data for key in identifiers]
            )
        ]
        opened.clear_keypoints()
        opened.clear_descriptors()
        for key, keep in zip(identifiers, kept, strict=True):
            opened.write_keypoints(key, keypoints[key][keep])
            described[key].data = described[key].data[keep]
            opened.write_descriptors(key, described[key])
    finally:
        opened.close()


def _match(database: Path, names: Sequence[str], settings: SfmSettings) -> None:
    read = feature_counts(database)
    blocks = sorted(_pair_blocks([name for name in names if name in read]), key=len, reverse=True)
    total = sum(map(len, blocks))
    match = match_pairs if min(processors(), len(blocks)) == 1 else match_apart
    values = {
        "seed": settings.seed,
        "guided_matching": settings.guided_matching,
        "max_ratio": settings.max_ratio,
        "verification_trials": settings.verification_trials,
    }

    def work(place: Path, block: list[tuple[str, str]], token: Any) -> None:
        match(place, block, values, token)
        bar.update(len(block))

    with progress(range(total), "matches", total=total, unit="pair") as bar:
        _shared_out(database, settings.seed, blocks, work, ("matches", "two_view_geometries"))


def _pair_blocks(names: Sequence[str]) -> list[list[tuple[str, str]]]:
    """Return all pairs in square blocks, because COLMAP indexes the features of an image again in every call."""
    groups = list(_chunks(names, _MATCHING_BLOCK))
    blocks = [list(combinations(group, 2)) for group in groups]
    blocks += [list(product(a, b)) for a, b in combinations(groups, 2)]
    return [block for block in blocks if block]


def run(function: Callable[..., ResultT], seed: int, **arguments: Any) -> ResultT:
    """Call a function of pycolmap in a separate thread, so that Ctrl-C cancels it instead of waiting for its end.

    COLMAP's generator belongs to the thread, so it is seeded there.
    """
    return _run_together([partial(function, **arguments)], seed)[0]


def _run_together(functions: Sequence[Callable[..., ResultT]], seed: int) -> list[ResultT]:
    """Do what `run` does for several functions at once, each in a thread of its own."""
    token = pycolmap.CancellationToken()
    outcomes: dict[int, ResultT] = {}
    errors: list[BaseException] = []

    def call(index: int) -> None:
        try:
            pycolmap.set_random_seed(seed)
            outcomes[index] = functions[index](cancellation_token=token)
        except BaseException as error:  # raised in the thread of the caller
            errors.append(error)
            token.cancel()

    threads = [threading.Thread(target=call, args=(index,), daemon=True) for index in range(len(functions))]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            while thread.is_alive():
                thread.join(_POLL_S)
    except BaseException:
        token.cancel()
        for thread in threads:
            thread.join()
        raise
    if errors:
        raise errors[0]
    return [outcomes[index] for index in range(len(functions))]


def _shared_out(
    database: Path, seed: int, items: Iterable[ItemT], work: Callable[[Path, ItemT, Any], None], tables: Sequence[str]
) -> None:
    """Do the items of a step on all processors, each of which writes into a copy of the database.

    What an item adds does not depend on the others, nor on who does it.

    Args:
        database: The database, which has what `work` reads.
        seed: Seed of each item.
        items: What is to be done.
        work: Function that adds the results of an item to a database, given a token that cancels it.
        tables: The tables to which it adds rows.
    """
    pending = deque(items)
    copies = [database.with_suffix(f".copy{k}.db") for k in range(1, min(processors(), len(pending), 1 + _COPIES))]

    def take(place: Path, cancellation_token: Any) -> None:
        while pending and not cancellation_token.is_cancelled:
            try:
                item = pending.popleft()
            except IndexError:  # another thread took the last one
                return
            pycolmap.set_random_seed(seed)
            work(place, item, cancellation_token)

    for copy in copies:
        shutil.copyfile(database, copy)
    _run_together([partial(take, place) for place in (database, *copies)], seed)
    for copy in copies:
        _add_rows(database, copy, tables)
        copy.unlink()


def _add_rows(database: Path, source: Path, tables: Sequence[str]) -> None:
    """Add the rows of tables of a copy of a database, whose keys the database does not have."""
    with closing(sqlite3.connect(database)) as opened, opened:
        opened.execute("ATTACH DATABASE ? AS source", (str(source),))
        for table in tables:
            opened.execute(f"INSERT INTO {table} SELECT * FROM source.{table}")


def _groups(images: Sequence[SfmImage]) -> list[list[SfmImage]]:
    groups: dict[str, list[SfmImage]] = {}
    for image in images:
        groups.setdefault(image.camera, []).append(image)
    return list(groups.values())


def _chunks(items: Sequence[Any], size: int) -> Iterable[Sequence[Any]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def count(database: Path, read: Callable[[Any], ResultT]) -> ResultT:
    """Return what a function reads from an opened database."""
    opened = pycolmap.Database.open(database)
    try:
        return read(opened)
    finally:
        opened.close()


def _existing_camera(database: Path, image: str) -> int:
    """Return the camera of an image that is already in the database, or -1."""

    def read(opened: Any) -> int:
        return opened.read_image_with_name(image).camera_id if opened.exists_image(image) else -1

    return count(database, read)


def _name_cameras(database: Path, images: Sequence[SfmImage]) -> None:
    names = {image.name: image.camera for image in images}
    identifiers = {
        image.camera_id: names[image.name] for image in count(database, lambda opened: opened.read_all_images())
    }
    lines = [f"{identifier} {name}\n" for identifier, name in sorted(identifiers.items())]
    database.with_suffix(".cameras.txt").write_text("".join(lines), encoding="utf-8")


def camera_names(database: Path) -> dict[int, str]:
    """Return the name of each camera of a database by its identifier."""
    lines = database.with_suffix(".cameras.txt").read_text(encoding="utf-8").splitlines()
    return {int(line.split(" ", 1)[0]): line.split(" ", 1)[1] for line in lines}
