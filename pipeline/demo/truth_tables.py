"""What a simulated scene allows: estimates next to what is truly so. Nothing that is fitted sees any of this."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.models import Model
from ...datasets.scenes import TruthFile
from ...schemas import (
    BodyCheck,
    CalibrationCheck,
    CalibrationReport,
    CamerasFile,
    ComparedParameter,
    Parameter,
    SplatCheck,
)
from ..physics.contact import restitution
from ..sfm.scale import umeyama
from ..splats.mesh import read_mesh, sample_surface

Array = NDArray[np.float64]

OBJECT = "object"
"""The scenes' name of the free body that `truth.json` describes."""
_SURFACE_SPACING_M = 0.003


def check_calibration(report: CalibrationReport, cameras: CamerasFile, truth: TruthFile) -> CalibrationCheck:
    """Return how far the cameras are from the true ones.

    Centres are compared as they are, in metres in the world frame; the scale is that of the similarity transform that
    fits the estimated centres to the true ones best.
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
    """Return the held-out figures of the stage sg-gs, and the object's colliding surface against its true one.

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

    Exact outside; inside it is that of the sphere in which a point lies deepest.

    Args:
        points: Shape (P, 3) [m].
        centers: Shape (S, 3), same frame [m].
        radii: Shape (S,) [m].
    """
    return (np.linalg.norm(points[:, None] - centers[None], axis=2) - radii).min(1)


def compare_parameters(parameters: Sequence[Parameter], truth: TruthFile) -> tuple[ComparedParameter, ...]:
    """Put the true values next to a model's parameters, where the truth has such a number."""
    true = true_parameters(truth)
    return tuple(
        ComparedParameter(parameter=parameter, true_value=true.get(parameter.name), covered=_covered(parameter, true))
        for parameter in parameters
    )


def true_parameters(truth: TruthFile) -> dict[str, float]:
    """Return the true values by the names of a model's parameters.

    MuJoCo has no restitution, stiffness or damping of a contact; those are derived from its natural time and damping
    ratio by the formulas of this package's own contact law, with the object's mass.
    """
    contact, mass = truth.contact, truth.object.mass_kg
    tau, zeta = contact.natural_time_s, contact.damping_ratio
    com = dict(zip("xyz", truth.object.com_m, strict=True))
    return {
        "friction": contact.friction,
        "contact_time_s": tau,
        "damping_ratio": zeta,
        "ground_offset_m": 0.0,  # the scenes stand on z = 0
        "restitution": float(restitution(torch.tensor(zeta, dtype=torch.float64))),
        "stiffness_n_m": mass / tau**2,
        "damping_n_s_m": 2 * zeta * mass / tau,
        f"{OBJECT}.mass_kg": mass,
        **{f"{OBJECT}.com_{axis}_m": value for axis, value in com.items()},
    }


def _covered(parameter: Parameter, true: dict[str, float]) -> bool | None:
    if parameter.interval_95 is None or parameter.name not in true:
        return None
    low, high = parameter.interval_95
    return bool(low <= true[parameter.name] <= high)


def _centers(estimated: CamerasFile, true: CamerasFile) -> tuple[Array, Array]:
    """Return the centres of the cameras that both files have [m], each of shape (N, 3)."""
    pairs = [(estimated.images[name].T_world_cam, true.images[name].T_world_cam) for name in estimated.images]
    pairs += [(estimated.videos[name].T_world_cam, true.videos[name].T_world_cam) for name in estimated.videos]
    poses = np.array(pairs, np.float64)
    return poses[:, 0, :3, 3], poses[:, 1, :3, 3]
