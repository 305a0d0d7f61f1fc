"""Comparison of estimates with the true values of a simulated scene, which no fit sees."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.models.model import Model
from ...datasets.synthetic import TruthFile
from ...schemas import (
    BodyCheck,
    CalibrationCheck,
    CalibrationReport,
    CamerasFile,
    ComparedParameter,
    FittedParameter,
    SplatCheck,
)
from ..calibrate.world_frame.metric_scale import umeyama
from ..geometry.mesh import read_mesh, sample_surface
from ..physics.contact_law import restitution

Array = NDArray[np.float64]

OBJECT = "object"
"""Name of the free body that `truth.json` of a scene describes."""
_SURFACE_SPACING_M = 0.003
"""Distance between the points that are sampled on the true surface [m]."""


def check_calibration(report: CalibrationReport, cameras: CamerasFile, truth: TruthFile) -> CalibrationCheck:
    """Compare the calibrated cameras with the true ones.

    Centres are compared in metres in the world frame, without alignment; the scale is that of the similarity transform
    that fits the estimated centres to the true ones best.
    """
    estimated, true = _centers(cameras, truth.cameras)
    error = np.linalg.norm(estimated - true, axis=1)
    return CalibrationCheck(
        photos=report.photos,
        photos_registered=report.photos_registered,
        video_cameras=len(report.videos),
        video_cameras_registered=sum(verdict.registered for verdict in report.videos.values()),
        reprojection_error_px=report.reprojection_error_px,
        center_error_median_m=float(np.median(error)),
        center_error_max_m=float(error.max()),
        scale_error=1 / umeyama(estimated, true).scale - 1,
        scale_std=report.scale.relative_std,
        scale_source=report.scale.source,
        self_check=report.self_check.passed,
    )


def check_splats(model: Model, mesh: Path) -> SplatCheck:
    """Return the held-out figures of the stage sg-gs, and the errors of the object's collision surface.

    Args:
        model: The fitted model.
        mesh: The true surface of the object, in its body frame, metres.
    """
    held_out = model.fit.stages["sg-gs"].get("held_out", {})
    bodies = []
    for body in model.file.bodies:
        if body.name != OBJECT or body.name not in model.body_splats:
            continue
        collision = model.collision[body.name]
        points = sample_surface(read_mesh(mesh), _SURFACE_SPACING_M)
        centers, scales = (np.asarray(values, np.float64) for values in (collision.means, collision.scales))
        gap = sphere_distance(points, centers, body.radius_factor * scales)
        bodies.append(
            BodyCheck(
                body=body.name,
                visual_spheres=len(model.body_splats[body.name].means),
                collision_spheres=len(collision.means),
                surface_error_mean_m=float(np.abs(gap).mean()),
                surface_error_95_m=float(np.percentile(np.abs(gap), 95)),
                surface_bias_m=float(gap.mean()),
            )
        )
    return SplatCheck(
        held_out_photos=len(held_out.get("photos", ())),
        psnr_db=held_out.get("psnr_db"),
        psnr_object_db=held_out.get("psnr_object_db"),
        mask_iou=held_out.get("mask_iou"),
        scene_spheres=0 if model.scene is None else len(model.scene.means),
        bodies=tuple(bodies),
    )


def sphere_distance(points: Array, centers: Array, radii: Array) -> Array:
    """Return the signed distance of points to a union of spheres, positive outside [m], shape (P,).

    The distance is exact outside; inside it is that to the sphere in which a point lies deepest.

    Args:
        points: Shape (P, 3) [m].
        centers: Shape (S, 3), same frame [m].
        radii: Shape (S,) [m].
    """
    return (np.linalg.norm(points[:, None] - centers[None], axis=2) - radii).min(1)


def compare_parameters(parameters: Sequence[FittedParameter], truth: TruthFile) -> tuple[ComparedParameter, ...]:
    """Pair a model's parameters with their true values, where these are known."""
    true = true_parameters(truth)
    return tuple(
        ComparedParameter(parameter=parameter, true_value=true.get(parameter.name), covered=_covered(parameter, true))
        for parameter in parameters
    )


def true_parameters(truth: TruthFile) -> dict[str, float]:
    """Return the true values by the names of a model's parameters.

    MuJoCo has no restitution, stiffness or damping of a contact; these are derived from its natural time and damping
    ratio by the formulas of this package's contact law, with the object's mass.
    """
    contact, mass = truth.contact, truth.object.mass_kg
    tau, zeta = contact.natural_time_s, contact.damping_ratio
    com = dict(zip("xyz", truth.object.com_m, strict=True))
    return {
        "friction": contact.friction,
        "contact_time_s": tau,
        "damping_ratio": zeta,
        "ground_offset_m": 0.0,  # the ground of the scenes is z = 0
        "restitution": float(restitution(torch.tensor(zeta, dtype=torch.float64))),
        "stiffness_n_m": mass / tau**2,
        "damping_n_s_m": 2 * zeta * mass / tau,
        f"{OBJECT}.mass_kg": mass,
        **{f"{OBJECT}.com_{axis}_m": value for axis, value in com.items()},
    }


def _covered(parameter: FittedParameter, true: dict[str, float]) -> bool | None:
    if parameter.interval_95 is None or parameter.name not in true:
        return None
    low, high = parameter.interval_95
    return bool(low <= true[parameter.name] <= high)


def _centers(estimated: CamerasFile, true: CamerasFile) -> tuple[Array, Array]:
    """Return the centres of the estimated and the true cameras [m], each of shape (N, 3)."""
    pairs = [(estimated.images[name].T_world_cam, true.images[name].T_world_cam) for name in estimated.images]
    pairs += [(estimated.videos[name].T_world_cam, true.videos[name].T_world_cam) for name in estimated.videos]
    poses = np.array(pairs, np.float64)
    return poses[:, 0, :3, 3], poses[:, 1, :3, 3]
