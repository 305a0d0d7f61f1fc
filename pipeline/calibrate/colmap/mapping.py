"""Adapter of pycolmap: cameras and points from verified matches, for one camera model or refined to another.

The matches are the same for all camera models, so that several are tried on one database. Every seed is set, and one
thread is used; see `colmap`.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as Map
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pycolmap

from ....datasets.io.progress import progress
from ....schemas import CameraIntrinsics
from ..observation_noise import moved_by_dropping, noise_by_image, noise_px
from ..reconstruction import Array, SfmCamera, SfmModel
from .features import camera_names, count, run

_Given = TypeVar("_Given")
_MIN_MODEL_IMAGES = 3
LOSS_SCALE = 2.0
"""Scale of the Cauchy loss, in standard deviations of a coordinate of the residuals."""
_KEEP_WITHIN = (4.0, 3.0)
"""Residuals above this many standard deviations are taken for wrong matches, in turn, each after an adjustment."""
_LEAST_PARALLAX = 0.002
"""Angle between the rays of a point [rad] below which it is dropped; COLMAP triangulates none below 0.026."""


@dataclass(frozen=True, kw_only=True)
class Mapped:
    """A connected model as COLMAP has it, and the names of its cameras."""

    reconstruction: Any
    """pycolmap's reconstruction; what adjusts it works on a copy."""
    names: dict[int, str]
    """Name of each camera by COLMAP's identifier."""
    noise_px: Map[str, float] = field(default_factory=dict)
    """Noise of a coordinate of each image's observations [px] before some were dropped; empty where none were."""
    moved: Map[str, tuple[float, float]] = field(default_factory=dict)
    """How far dropping these moved each centre, of the extent of all, and turned the camera [rad]; likewise."""

    @property
    def image_count(self) -> int:
        """Number of registered images."""
        return int(self.reconstruction.num_reg_images())

    def model(self) -> SfmModel:
        """Return the model as plain arrays."""
        return _plain_model(self.reconstruction, self.names)

    def with_observations(self, model: SfmModel) -> Mapped:
        """Return the model with the observations of `model`, which is as `model()` returned it in all else."""
        new = pycolmap.Reconstruction()
        for camera in self.reconstruction.cameras.values():
            new.add_camera_with_trivial_rig(camera)
        tracks = [pycolmap.Track() for _ in model.points]
        for image in sorted(self.reconstruction.images.values(), key=lambda one: one.image_id):
            if image.has_pose:
                pixels, seen = model.observations[image.name]
                points = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels])
                copy = pycolmap.Image(
                    name=image.name, camera_id=image.camera_id, image_id=image.image_id, points2D=points
                )
                new.add_image_with_trivial_frame(copy, image.cam_from_world())
                for index, point in enumerate(seen):
                    tracks[point].add_element(image.image_id, index)
        for position, color, track in zip(model.points, model.colors, tracks, strict=True):
            if track.length() > 1:
                new.add_point3D(position, track, color)
        return Mapped(reconstruction=new, names=self.names)

    def residuals_px(self) -> Array:
        """Return the lengths of the reprojection errors of all observations [px], shape (observation,)."""
        return np.concatenate([lengths for _, _, lengths in _residuals(self.reconstruction)])


def map_database(
    database: Path, root: Path, seed: int, models: Map[str, str], known: Map[str, CameraIntrinsics]
) -> list[Mapped]:
    """Estimate cameras and points from the matches of a database with given camera models.

    Args:
        database: The database of `colmap.build_database`.
        root: Folder of the images.
        seed: Seed of the mapping.
        models: COLMAP's camera model of each camera: SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV.
        known: Intrinsics of cameras that are not estimated; they replace the camera's entry in `models`.

    Returns:
        All connected models, the one with most images first.
    """
    names = camera_names(database)
    fixed = _set_cameras(database, names, models, known)
    options = _options(seed)
    options.constant_cameras = fixed
    options.mapper.constant_cameras = fixed
    output = database.with_suffix(".models")
    output.mkdir(exist_ok=True)
    images = count(database, lambda opened: opened.num_images())
    with progress(range(images), "mapping", total=images, unit="image") as bar:
        found = run(
            pycolmap.incremental_mapping,
            seed,
            database_path=database,
            image_path=root,
            output_path=output,
            options=options,
            next_image_callback=lambda: bar.update(1),
        )
    mapped = [Mapped(reconstruction=found[key], names=names) for key in sorted(found)]
    return sorted(mapped, key=lambda one: -one.image_count)


def adjusted(mapped: Mapped, models: Map[str, str], known: Map[str, CameraIntrinsics], seed: int) -> Mapped:
    """Adjust a model with other camera models, and a loss that wrong matches do not pull.

    Args:
        mapped: The model; it stays as it is.
        models: Camera model of each camera, at least as rich as the one that it has.
        known: Intrinsics of cameras that are not estimated.
        seed: Seed of COLMAP.
    """
    copy = pycolmap.Reconstruction(mapped.reconstruction)
    for identifier, camera in copy.cameras.items():
        if mapped.names[identifier] not in known:
            _enrich(camera, models[mapped.names[identifier]])
    _adjust(copy, _fixed(mapped, known), seed)
    return Mapped(reconstruction=copy, names=mapped.names)


def adjusts_without_blas(mapped: Mapped) -> bool:
    """Return whether models of so few images are adjusted with a dense solver, which needs no BLAS.

    That of pycolmap's wheels must not be called twice at once, see `match_pairs`; sparse solvers call it.
    """
    return mapped.image_count <= pycolmap.BundleAdjustmentOptions().ceres.max_num_images_direct_dense_cpu_solver


def with_focal_lengths(
    mapped: Mapped, focals_px: Map[str, float], known: Map[str, CameraIntrinsics], seed: int
) -> Mapped:
    """Give cameras of an adjusted model their focal lengths [px], and adjust all but focal lengths again."""

    def scaled(camera: Any, values: Array, focal_px: float) -> None:
        values[camera.focal_length_idxs()] *= focal_px / camera.mean_focal_length()

    return _with_numbers(mapped, focals_px, scaled, known, seed, focal_lengths=False)


def with_principal_points(
    mapped: Mapped, points_px: Map[str, Array], known: Map[str, CameraIntrinsics], seed: int
) -> Mapped:
    """Give cameras of an adjusted model their principal points [px], shape (2,), and adjust all else again."""

    def moved(camera: Any, values: Array, point_px: Array) -> None:
        values[camera.principal_point_idxs()] = point_px

    return _with_numbers(mapped, points_px, moved, known, seed)


def _with_numbers(
    mapped: Mapped,
    given: Map[str, _Given],
    put: Callable[[Any, Array, _Given], None],
    known: Map[str, CameraIntrinsics],
    seed: int,
    focal_lengths: bool = True,
) -> Mapped:
    """Put what is given of each camera into its numbers, and adjust a copy of the model again."""
    copy = pycolmap.Reconstruction(mapped.reconstruction)
    for identifier, camera in copy.cameras.items():
        if mapped.names[identifier] in given:
            values = np.array(camera.params)
            put(camera, values, given[mapped.names[identifier]])
            camera.params = values.tolist()
    _adjust(copy, _fixed(mapped, known), seed, focal_lengths=focal_lengths)
    return replace(mapped, reconstruction=copy)


def without_outliers(mapped: Mapped, known: Map[str, CameraIntrinsics], seed: int) -> Mapped:
    """Drop the observations of an adjusted model that are taken for wrong matches, and adjust it again, twice."""
    copy = pycolmap.Reconstruction(mapped.reconstruction)
    for limit in _KEEP_WITHIN:
        _drop_outliers(copy, limit)
        _drop_undetermined(copy)
        _adjust(copy, _fixed(mapped, known), seed)
    _drop_undetermined(copy)
    found, before = Mapped(reconstruction=copy, names=mapped.names), mapped.model()
    return replace(found, noise_px=noise_by_image(before), moved=moved_by_dropping(before, found.model()))


def triangulated(mapped: Mapped, database: Path, root: Path, seed: int) -> Mapped:
    """Return a model with the points of all matches of a database that agree with its cameras, which stay.

    Args:
        mapped: The model.
        database: The database of `colmap.build_database`; its cameras become those of the model.
        root: Folder of the images.
        seed: Seed of COLMAP.
    """
    opened = pycolmap.Database.open(database)
    try:
        for camera in mapped.reconstruction.cameras.values():
            opened.update_camera(camera)
    finally:
        opened.close()
    output = database.with_suffix(".points")
    output.mkdir(exist_ok=True)
    found = run(
        lambda cancellation_token: pycolmap.triangulate_points(
            pycolmap.Reconstruction(mapped.reconstruction),
            database,
            root,
            output,
            clear_points=True,
            refine_intrinsics=False,
            options=_options(seed),
        ),
        seed,
    )
    return Mapped(reconstruction=found, names=mapped.names)


def _options(seed: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.num_threads = 1
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.min_model_size = _MIN_MODEL_IMAGES
    return options


def _set_cameras(
    database: Path, names: Map[int, str], models: Map[str, str], known: Map[str, CameraIntrinsics]
) -> set[int]:
    """Write cameras of the wanted models into the database; return the identifiers of those that are known."""
    opened = pycolmap.Database.open(database)
    try:
        for camera in opened.read_all_cameras():
            name, identifier = names[camera.camera_id], camera.camera_id
            if name in known:
                opened.update_camera(_known_camera(identifier, known[name]))
                continue
            new = pycolmap.Camera.create_from_model_name(
                identifier, models[name], camera.mean_focal_length(), camera.width, camera.height
            )
            new.has_prior_focal_length = camera.has_prior_focal_length
            opened.update_camera(new)
    finally:
        opened.close()
    return {identifier for identifier, name in names.items() if name in known}


def _known_camera(identifier: int, known: CameraIntrinsics) -> Any:
    camera = pycolmap.Camera.create_from_model_name(identifier, "OPENCV", known.fx, known.width, known.height)
    lens = [*known.distortion, 0.0, 0.0, 0.0, 0.0][:4]
    camera.params = [known.fx, known.fy, known.cx, known.cy, *lens]
    camera.has_prior_focal_length = True
    return camera


def _enrich(camera: Any, model: str) -> None:
    """Give a camera another model; what the present one has of lens and principal point is kept."""
    new = pycolmap.Camera.create_from_model_name(
        camera.camera_id, model, camera.mean_focal_length(), camera.width, camera.height
    )
    values = np.array(new.params)
    for here, there in (
        (new.principal_point_idxs(), camera.principal_point_idxs()),
        (new.extra_params_idxs(), camera.extra_params_idxs()),
    ):
        for k, j in zip(here, there, strict=False):  # the leading extra parameters are k1 and k2 in every model
            values[k] = camera.params[j]
    camera.model = new.model
    camera.params = values.tolist()


def _fixed(mapped: Mapped, known: Map[str, CameraIntrinsics]) -> set[int]:
    return {identifier for identifier in mapped.reconstruction.cameras if mapped.names[identifier] in known}


def _adjust(reconstruction: Any, fixed: set[int], seed: int, focal_lengths: bool = True) -> None:
    lengths = np.concatenate([lengths for _, _, lengths in _residuals(reconstruction)])
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = focal_lengths
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE * noise_px(lengths)
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    for identifier in fixed:
        config.set_constant_cam_intrinsics(identifier)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    run(lambda cancellation_token: adjuster.solve(), seed)


def _drop_outliers(reconstruction: Any, limit: float) -> None:
    residuals = _residuals(reconstruction)
    most = limit * noise_px(np.concatenate([lengths for _, _, lengths in residuals]))
    for image, observed, lengths in residuals:
        for index in observed[lengths > most]:
            if image.points2D[index].has_point3D():  # the point may be gone with its last but one observation
                reconstruction.delete_observation(image.image_id, int(index))


def _drop_undetermined(reconstruction: Any) -> None:
    """Drop points whose photos were all taken from one place, as a photo and a copy of it: they drift to infinity."""
    centers = {key: image.projection_center() for key, image in reconstruction.images.items() if image.has_pose}
    for key, point in list(reconstruction.points3D.items()):
        rays = np.array([centers[element.image_id] for element in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        if np.linalg.norm(rays - rays[0], axis=1).max() < _LEAST_PARALLAX:
            reconstruction.delete_point3D(key)


def _residuals(reconstruction: Any) -> list[tuple[Any, Any, Array]]:
    """Return each registered image with the indices of its observations and their reprojection errors [px].

    The error of a point behind the camera, as two photos from one place may triangulate it, is infinite.
    """
    found = []
    for image in sorted(reconstruction.images.values(), key=lambda one: one.image_id):
        observed = [k for k, point in enumerate(image.points2D) if point.has_point3D()] if image.has_pose else []
        if not observed:
            continue
        seen = np.array([image.points2D[k].xy for k in observed])
        world = np.array([reconstruction.points3D[image.points2D[k].point3D_id].xyz for k in observed])
        pose = image.cam_from_world().matrix()
        drawn = reconstruction.cameras[image.camera_id].img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        lengths = np.linalg.norm(drawn - seen, axis=1)  # COLMAP draws no point behind the camera: NaN
        found.append((image, np.array(observed), np.where(np.isnan(lengths), np.inf, lengths)))
    return found


def _plain_model(model: pycolmap.Reconstruction, camera_names: dict[int, str]) -> SfmModel:
    model.update_point_3d_errors()
    point_ids = sorted(model.points3D)
    index = {point_id: i for i, point_id in enumerate(point_ids)}
    points = [model.points3D[point_id] for point_id in point_ids]
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    poses, observations = {}, {}
    for image in images:
        poses[image.name] = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        seen = [point for point in image.points2D if point.has_point3D()]
        observations[image.name] = (
            np.array([point.xy for point in seen], dtype=float).reshape(-1, 2),
            np.array([index[point.point3D_id] for point in seen], dtype=np.int64),
        )
    used = {image.camera_id for image in images}
    return SfmModel(
        cameras={camera_names[key]: _plain_camera(model.cameras[key]) for key in sorted(used)},
        image_camera={image.name: camera_names[image.camera_id] for image in images},
        T_cam_world=poses,
        points=np.array([point.xyz for point in points], dtype=float).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        observations=observations,
        reprojection_error_px=float(model.compute_mean_reprojection_error()),
    )


def _plain_camera(camera: pycolmap.Camera) -> SfmCamera:
    focal = [float(value) for value in camera.params[camera.focal_length_idxs()]]
    cx, cy = (float(value) for value in camera.params[camera.principal_point_idxs()])
    extra = [float(value) for value in camera.params[camera.extra_params_idxs()]]
    k1, k2, p1, p2 = [*extra, 0.0, 0.0, 0.0, 0.0][:4]
    return SfmCamera(
        width=camera.width, height=camera.height, fx=focal[0], fy=focal[-1], cx=cx, cy=cy, distortion=(k1, k2, p1, p2)
    )
