"""Metric scale and world frame: from markers, a known distance, or a known distance between two cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ....schemas import InputDataError, KnownCameraDistance, KnownDistance, Marker, NotConvergedError
from ..reconstruction import Array, SfmModel, Similarity
from ..triangulation import TriangulatedPoint, center_std, triangulate
from .markers import marker_corners

Sightings = Mapping[int, Mapping[str, Array]]
"""Corner pixels (4, 2) by marker id and image."""

CORNER_NOISE_PX = 0.1
"""Minimum standard deviation of a refined marker corner [px]."""
CORNER_BIAS_PX = 0.1
"""Standard deviation of the error that all corners of a marker share (blur and exposure move its edges) [px]."""
CLICK_NOISE_PX = 0.5
"""Minimum standard deviation of a point that was marked by hand [px]."""
MAX_MARKER_MISFIT = 0.05
"""Maximum disagreement of posed markers, as a fraction of their extent; above it a pose or size is wrong."""


@dataclass(frozen=True, kw_only=True)
class MetricFrame:
    """The transform from the model's frame to metres."""

    similarity: Similarity
    """Transform from the model frame to the metric frame."""
    source: str
    """Description of the source of the scale."""
    relative_std: float
    """Standard error of the scale, as a fraction."""
    fixes_frame: bool
    """Whether the transform defines the axes and origin of the world too; otherwise it only scales."""
    residual_m: float | None = None
    """Root mean square distance of the marker corners from their given positions [m]."""


def umeyama(source: Array, target: Array) -> Similarity:
    """Return the least-squares similarity from matched points.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".

    Args:
        source: Points, shape (point, 3), at least 3 that are not on one line.
        target: Matched target points, shape (point, 3).
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / (a**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def from_markers(model: SfmModel, markers: Sequence[Marker], sightings: Sightings) -> MetricFrame:
    """Return scale and world frame from ArUco markers of known size.

    Markers with a pose fix scale, axes and origin together. Without any pose, the scale comes from all sides
    and diagonals, and the world frame is that of the first marker: origin at its centre, z out of it.

    Raises:
        NotConvergedError: If no marker is visible well enough in two registered photos.
        InputDataError: If posed markers contradict each other.
    """
    corners = {marker.id: _triangulated_corners(model, sightings.get(marker.id, {})) for marker in markers}
    usable = [marker for marker in markers if corners[marker.id]]
    if not usable:
        raise NotConvergedError(
            _no_marker(model, markers, sightings),
            todo=(
                "check aruco_dictionary and the ids in capture.toml, [calibration]; let the marker be sharp and "
                "at least 40 pixels wide in three photos."
            ),
        )
    posed = [marker for marker in usable if marker.pose is not None]
    return _from_posed(posed, corners, model) if posed else _from_sizes(usable, corners, model)


def from_known_distance(model: SfmModel, known: KnownDistance) -> MetricFrame:
    """Return the scale from two marked points at a known distance.

    Raises:
        InputDataError: If a point is not marked consistently in two registered photos.
    """
    a, b = _marked_point(model, known.a_px, "a_px"), _marked_point(model, known.b_px, "b_px")
    offset = b.position - a.position
    length = float(np.linalg.norm(offset))
    direction = offset / length
    std = float(np.sqrt(direction @ (a.covariance + b.covariance) @ direction)) / length
    source = f"known distance of {known.distance_m:g} m between two marked points"
    return MetricFrame(
        similarity=scaling(known.distance_m / length), source=source, relative_std=std, fixes_frame=False
    )


def from_camera_distance(model: SfmModel, known: KnownCameraDistance) -> MetricFrame:
    """Return the scale from the known distance between the optical centres of two photos.

    Raises:
        InputDataError: If one of the photos is not registered.
    """
    for name in known.images:
        if name not in model.T_cam_world:
            raise InputDataError(
                f"capture.toml: calibration.known_camera_distance: the photo '{name}' is not registered.",
                "photos that are registered.",
                "name two of those that calibrate lists as registered.",
            )
    offset = model.center(known.images[1]) - model.center(known.images[0])
    length = float(np.linalg.norm(offset))
    if length == 0.0:
        raise InputDataError(
            "capture.toml: calibration.known_camera_distance names the same place twice.",
            "two photos from different places.",
            "name two photos between whose cameras you measured the distance.",
        )
    noise = max(model.reprojection_error_px, CORNER_NOISE_PX)
    stds = [center_std(model, name, offset / length, noise) for name in known.images]
    source = f"known distance of {known.distance_m:g} m between the cameras of {known.images[0]} and {known.images[1]}"
    std = float(np.linalg.norm(stds)) / length
    return MetricFrame(
        similarity=scaling(known.distance_m / length), source=source, relative_std=std, fixes_frame=False
    )


def _triangulated_corners(model: SfmModel, sightings: Mapping[str, Array]) -> list[TriangulatedPoint]:
    """Return the four triangulated corners of a marker, or an empty list if one of them fails."""
    corners = []
    for index in range(4):
        pixels = {image: (float(xy[index, 0]), float(xy[index, 1])) for image, xy in sightings.items()}
        corner = triangulate(model, pixels, CORNER_NOISE_PX)
        if corner is None:
            return []
        corners.append(corner)
    return corners


def _from_posed(
    posed: Sequence[Marker], corners: Mapping[int, list[TriangulatedPoint]], model: SfmModel
) -> MetricFrame:
    source = np.array([corner.position for marker in posed for corner in corners[marker.id]])
    target = np.concatenate([_world_corners(marker) for marker in posed])
    similarity = umeyama(source, target)
    misfit = similarity.points(source) - target
    residual = float(np.sqrt((misfit**2).sum(axis=1).mean()))
    centered = target - target.mean(axis=0)
    extent = float(np.sqrt((centered**2).sum(axis=1).mean()))
    if residual > MAX_MARKER_MISFIT * extent:
        per_marker = np.linalg.norm(misfit, axis=1).reshape(-1, 4).mean(axis=1)
        found = ", ".join(f"marker {m.id}: {1000 * e:.1f} mm" for m, e in zip(posed, per_marker, strict=True))
        raise InputDataError(
            f"capture.toml: [calibration] markers do not lie where their poses say: {found}.",
            f"a misfit of at most {1000 * MAX_MARKER_MISFIT * extent:.1f} mm.",
            "measure side_m and pose again (x right and y up as printed, z out of the paper).",
        )
    freedom = max(target.size - 7, 1)
    misfit_variance = float((misfit**2).sum()) / freedom
    covariance = np.array([corner.covariance for marker in posed for corner in corners[marker.id]])
    noise_variance = similarity.scale**2 * float(np.trace(covariance, axis1=1, axis2=2).mean()) / 3.0
    # A scale error ds moves a corner by ds * q, so least squares gives var(ds) = sigma^2 / sum |q|^2; an outward
    # shift d of every corner looks like ds = sum q.d / sum |q|^2.
    spread = float((centered**2).sum())
    outward = np.concatenate([_world_corners(marker) - _world_corners(marker).mean(axis=0) for marker in posed])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    shift = CORNER_BIAS_PX * np.repeat([_metres_per_pixel(m, corners[m.id], model) for m in posed], 4)
    bias = float((centered * outward * shift[:, None]).sum()) / spread
    std = float(np.sqrt(max(misfit_variance, noise_variance) / spread + bias**2))
    names = ", ".join(str(marker.id) for marker in posed)
    return MetricFrame(
        similarity=similarity,
        source=f"ArUco marker(s) {names} of known size and pose",
        relative_std=std,
        fixes_frame=True,
        residual_m=residual,
    )


def _from_sizes(
    usable: Sequence[Marker], corners: Mapping[int, list[TriangulatedPoint]], model: SfmModel
) -> MetricFrame:
    scales, stds = [], []
    for marker in usable:
        local = marker_corners(marker.side_m)
        found = np.array([corner.position for corner in corners[marker.id]])
        fit = umeyama(found, local)
        misfit = fit.points(found) - local
        noise = fit.scale**2 * np.mean([np.trace(corner.covariance) for corner in corners[marker.id]]) / 3.0
        variance = max(float((misfit**2).sum()) / (local.size - 7), noise) / float((local**2).sum())
        bias = CORNER_BIAS_PX * _metres_per_pixel(marker, corners[marker.id], model) / np.linalg.norm(local[0])
        scales.append(fit.scale)
        stds.append(float(np.sqrt(variance + bias**2)))
    weights = 1.0 / np.square(stds)
    scale = float(np.average(scales, weights=weights))
    first = usable[0]
    found = np.array([corner.position for corner in corners[first.id]])
    frame = umeyama(scale * found, marker_corners(first.side_m))
    similarity = Similarity(scale, frame.rotation, -scale * frame.rotation @ found.mean(axis=0))
    residual = float(np.sqrt(((similarity.points(found) - marker_corners(first.side_m)) ** 2).sum(axis=1).mean()))
    # Markers that disagree beyond their errors widen the interval (Birge ratio).
    spread = float(np.sqrt(np.average((np.array(scales) - scale) ** 2, weights=weights)))
    std = float(np.hypot(1.0 / np.sqrt(weights.sum()), spread / scale / np.sqrt(max(len(scales) - 1, 1))))
    names = ", ".join(str(marker.id) for marker in usable)
    source = f"ArUco marker(s) {names} of known size; the world frame is that of marker {first.id}"
    return MetricFrame(similarity=similarity, source=source, relative_std=std, fixes_frame=True, residual_m=residual)


def _metres_per_pixel(marker: Marker, corners: Sequence[TriangulatedPoint], model: SfmModel) -> float:
    """Return the size of a pixel at a marker in its nearest views [m]: side over projected side."""
    side = np.linalg.norm(corners[1].position - corners[0].position)
    middle = np.mean([corner.position for corner in corners], axis=0)
    widths = [
        model.camera(image).focal_px * side / np.linalg.norm(middle - model.center(image))
        for image in corners[0].images
    ]
    return marker.side_m / float(np.median(widths))


def _world_corners(marker: Marker) -> Array:
    """Return a posed marker's corners in the world frame [m], shape (4, 3)."""
    pose = marker.pose
    if pose is None:
        raise ValueError(f"marker {marker.id} has no pose")
    turn = Rotation.from_quat(pose.quat_wxyz, scalar_first=True)
    return turn.apply(marker_corners(marker.side_m)) + np.array(pose.position_m)


def _marked_point(model: SfmModel, pixels: Mapping[str, tuple[float, float]], field: str) -> TriangulatedPoint:
    point = triangulate(model, pixels, CLICK_NOISE_PX)
    if point is None:
        registered = [name for name in pixels if name in model.T_cam_world]
        raise InputDataError(
            f"capture.toml: calibration.known_distance.{field}: the marks do not meet in one point "
            f"({len(registered)} of {len(pixels)} photos registered).",
            "marks within 4 px of one point in at least 2 registered photos.",
            "mark the point again, or in other photos.",
        )
    return point


def scaling(scale: float) -> Similarity:
    """Return the change of the unit of length alone."""
    return Similarity(scale, np.eye(3), np.zeros(3))


def _no_marker(model: SfmModel, markers: Sequence[Marker], sightings: Sightings) -> str:
    wanted = ", ".join(str(marker.id) for marker in markers)
    seen = ", ".join(
        f"{identifier} in {sum(image in model.T_cam_world for image in images)}"
        for identifier, images in sorted(sightings.items())
    )
    return f"Marker(s) {wanted} not found in two registered photos. Seen (id in photos): {seen or 'none'}."
