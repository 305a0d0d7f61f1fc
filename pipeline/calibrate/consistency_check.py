"""Self-check of a structure-from-motion model against the verified matches that it was estimated from.

A model may register every image with a low reprojection error and still be bent or folded: the mapper drops the
observations that disagree. The verified matches of image pairs are independent of the mapper, so they reveal this.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .reconstruction import Array, SfmModel, VerifiedPair

CONSISTENT_BELOW_PX = 4.0
"""Threshold on the Sampson error [px], below which an inlier agrees with the model."""
PAIR_MIN_INLIERS = 50
"""Minimum number of inliers of a pair that is checked."""
STRONG_PAIR_INLIERS = 200
"""Minimum number of inliers of a strong pair, which is sufficient evidence to reject a model."""
MIN_CONSISTENT_FRACTION = 0.5
"""Minimum fraction of consistent inliers of a strong pair; below it the model is rejected."""
_NO_BASELINE = 1e-9
"""Baseline below which two cameras coincide and E vanishes, as a fraction of the model's extent."""


@dataclass(frozen=True)
class PairCheck:
    """Agreement of a verified pair with the model."""

    image_a: str
    """Name of the first image."""
    image_b: str
    """Name of the second image."""
    inliers: int
    """Number of verified matches."""
    consistent: float
    """Fraction of the inliers that agree with the model's relative pose."""


@dataclass(frozen=True)
class SelfCheck:
    """Result of the self-check of a model."""

    pairs: tuple[PairCheck, ...]
    """All registered pairs with at least `PAIR_MIN_INLIERS` inliers."""
    images_without_strong_pair: tuple[str, ...]
    """Registered images that are in no strong pair."""

    @property
    def strong(self) -> tuple[PairCheck, ...]:
        """The pairs that can reject a model."""
        return tuple(pair for pair in self.pairs if pair.inliers >= STRONG_PAIR_INLIERS)

    @property
    def failed(self) -> tuple[PairCheck, ...]:
        """The strong pairs that contradict the model, worst first."""
        bad = [pair for pair in self.strong if pair.consistent < MIN_CONSISTENT_FRACTION]
        return tuple(sorted(bad, key=lambda pair: (pair.consistent, -pair.inliers)))

    @property
    def passed(self) -> bool:
        """Whether no strong pair contradicts the model."""
        return not self.failed

    @property
    def worst(self) -> PairCheck | None:
        """The least consistent strong pair, or the least consistent pair if no pair is strong."""
        pairs = self.strong or self.pairs
        return min(pairs, key=lambda pair: (pair.consistent, -pair.inliers)) if pairs else None


def check_model(model: SfmModel, pairs: Iterable[VerifiedPair]) -> SelfCheck:
    """Compare the relative poses of a model with the verified matches.

    Rule and thresholds: a model is rejected if any pair with >= 200 verified inliers is less than 50 % consistent,
    an inlier being consistent below 4 px (Sampson).

    Args:
        model: The model.
        pairs: Verified pairs; those of unregistered images are skipped.
    """
    extent = float(np.ptp(model.centers(), axis=0).max()) if model.T_cam_world else 0.0
    checks = []
    for pair in pairs:
        registered = pair.image_a in model.T_cam_world and pair.image_b in model.T_cam_world
        if registered and len(pair.xy_a) >= PAIR_MIN_INLIERS:
            checks.append(_check_pair(model, pair, extent))
    strong = {name for c in checks if c.inliers >= STRONG_PAIR_INLIERS for name in (c.image_a, c.image_b)}
    return SelfCheck(tuple(checks), tuple(sorted(set(model.T_cam_world) - strong)))


def _check_pair(model: SfmModel, pair: VerifiedPair, extent: float) -> PairCheck:
    camera_a, camera_b = model.camera(pair.image_a), model.camera(pair.image_b)
    pose_a, pose_b = model.T_cam_world[pair.image_a], model.T_cam_world[pair.image_b]
    rotation = pose_b[:3, :3] @ pose_a[:3, :3].T
    translation = pose_b[:3, 3] - rotation @ pose_a[:3, 3]
    good = consistent_inliers(
        camera_a.rays(pair.xy_a),
        camera_b.rays(pair.xy_b),
        rotation,
        translation if np.linalg.norm(translation) > _NO_BASELINE * extent else np.zeros(3),
        0.5 * (camera_a.focal_px + camera_b.focal_px),
    )
    return PairCheck(pair.image_a, pair.image_b, len(good), float(good.mean()))


def consistent_inliers(rays_a: Array, rays_b: Array, R_b_a: Array, t_b_a: Array, focal_px: float) -> NDArray[np.bool_]:
    """Return whether each match agrees with a relative pose.

    A match agrees if its Sampson error is below 4 px and, where its parallax is beyond that noise, the point lies in
    front of both cameras (the Sampson error alone cannot distinguish t from -t). A short baseline needs no exception:
    the epipolar line runs through the image of the infinitely far point, so the error is at most the parallax. E
    vanishes only for a baseline of zero; the displacement from the rotated ray replaces it there.

    Args:
        rays_a: Ray slopes (x/z, y/z) in camera a [1], shape (match, 2).
        rays_b: The same in camera b.
        R_b_a: Rotation from camera a to camera b, shape (3, 3).
        t_b_a: Translation from camera a to camera b, any unit, shape (3,); zero for no baseline.
        focal_px: Focal length that turns slopes into pixels [px].

    Returns:
        Shape (match,).
    """
    a, b = _homogeneous(rays_a), _homogeneous(rays_b)
    if not np.any(t_b_a):
        turned = a @ R_b_a.T
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = np.linalg.norm(turned[:, :2] / turned[:, 2:] - rays_b, axis=1)
        return (turned[:, 2] > 0) & (moved * focal_px < CONSISTENT_BELOW_PX)
    error_px = sampson_error(rays_a, rays_b, R_b_a, t_b_a) * focal_px
    return (error_px < CONSISTENT_BELOW_PX) & ~_behind(a @ R_b_a.T, b, t_b_a, 2.0 * CONSISTENT_BELOW_PX / focal_px)


def sampson_error(rays_a: Array, rays_b: Array, R_b_a: Array, t_b_a: Array) -> Array:
    """Return the Sampson error of matches to E = [t]x R.

    Source: |b'Ea| / sqrt((Ea)_1^2 + (Ea)_2^2 + (E'b)_1^2 + (E'b)_2^2), Hartley and Zisserman, eq. 11.9.

    Args:
        rays_a: Ray slopes in camera a [1], shape (match, 2).
        rays_b: Ray slopes in camera b [1], shape (match, 2).
        R_b_a: Rotation from camera a to camera b, shape (3, 3).
        t_b_a: Translation from camera a to camera b, any unit but not zero, shape (3,).

    Returns:
        Error in units of slope [1], shape (match,).
    """
    x, y, z = t_b_a / np.linalg.norm(t_b_a)
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ R_b_a
    a, b = _homogeneous(rays_a), _homogeneous(rays_b)
    line_b, line_a = a @ essential.T, b @ essential
    algebraic = np.abs(np.sum(b * line_b, axis=1))
    gradient = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
    return algebraic / np.maximum(gradient, np.finfo(float).tiny)


def _behind(a: Array, b: Array, t: Array, min_parallax: float) -> NDArray[np.bool_]:
    """Return whether each point triangulates behind a camera, with a parallax [rad] above the noise.

    Derived: z_a and z_b minimise |z_a a + t - z_b b|^2, both rays in the axes of camera b.
    """
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    at, bt = a @ t, b @ t
    determinant = aa * bb - ab**2  # (|a| |b| sin(parallax))^2: positive unless the rays are equal
    z_a, z_b = ab * bt - bb * at, aa * bt - ab * at
    return (determinant > aa * bb * min_parallax**2) & ((z_a < 0) | (z_b < 0))


def _homogeneous(rays: Array) -> Array:
    return np.column_stack([rays, np.ones(len(rays))])
