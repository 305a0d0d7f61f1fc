"""Check of poses against pictures: labelled poses, projected without the renderer, must match masks and depth."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from ...datasets.capture.cameras import Camera
from ...datasets.models.model import Model
from ...datasets.rollouts.rollouts import Node
from ..geometry.viewpoint import rotation_matrix
from .faults import Fault
from .rollout import Rollout

SPHERE_RADIUS = 1.177
"""Radius at which a single opaque sphere transmits half of the light, in units of its scale s: sqrt(2 ln 2)."""
SOLID = 0.1
"""Minimum opacity of the spheres that are projected."""
MARGIN_PX = 2
"""Largest distance of a mask from the projected spheres [px]; overlapping spheres reach farther than single ones."""
MIN_INSIDE = 0.95
"""Minimum fraction of a body's mask within its projected spheres."""
MIN_IOU = 0.7
"""Minimum intersection over union of a body's mask and its projected spheres, without occluded pixels."""
MIN_IOU_PX = 80
"""Minimum size of a body for a check of the intersection over union [px]; smaller bodies are mostly rim."""
MIN_PIXELS = 20
"""Minimum size of a mask that is checked [px]."""
DEPTH_RADII = 4.0
"""Largest median difference of a body's depth from that of its nearest projected sphere [scale of its spheres]."""


@dataclass(kw_only=True)
class PictureFindings:
    """Results of the comparison over all pictures; lists have one entry per body and picture."""

    frames: int = 0
    """Number of pictures."""
    iou: list[float] = field(default_factory=list)
    """Intersection over union of the mask and the visible projected spheres."""
    inside: list[float] = field(default_factory=list)
    """Fraction of the mask within the projected spheres."""
    centre_px: list[float] = field(default_factory=list)
    """Distance between the centroids of the mask and of the visible projected spheres [px]."""
    depth_m: list[float] = field(default_factory=list)
    """Median difference between the labelled depth and that of the projected spheres [m]."""
    amodal_iou: list[float] = field(default_factory=list)
    """Intersection over union of the amodal mask and the projected spheres."""


@dataclass(frozen=True)
class _Painted:
    """The projected spheres of a body."""

    depth: np.ndarray
    """Depth of the nearest sphere [m], shape (H, W); 0 where no sphere is projected."""
    radius_m: float
    """Median scale of the spheres [m]."""

    @property
    def covered(self) -> np.ndarray:
        """Pixels with a projected sphere, shape (H, W)."""
        return self.depth > 0


@dataclass(frozen=True, kw_only=True)
class _Picture:
    """The labels of a picture."""

    camera: str
    """Name of the camera."""
    frame: int
    """Index of the frame in the rollout."""
    mask: np.ndarray
    """Index of the visible body + 1, shape (H, W); 0 for the background."""
    depth: np.ndarray
    """Depth [m], shape (H, W)."""
    amodal: list[np.ndarray]
    """Pixels that each body would cover alone, bool, shape (H, W)."""

    def fault(self, check: str, text: str, value: float, limit: float, body: str | None = None) -> Fault:
        """Return a fault at this picture."""
        return Fault(check=check, text=text, frame=self.frame, camera=self.camera, body=body, value=value, limit=limit)


def check_pictures(
    rollout: Rollout,
    model: Model,
    cameras: Collection[str],
    findings: PictureFindings,
    frames: Collection[int] | None = None,
) -> Iterator[Fault]:
    """Compare every body in pictures of a rollout with its pose.

    Args:
        rollout: The rollout.
        model: The dataset's model, with the spheres of the bodies.
        cameras: Names of the cameras whose pictures are compared; their poses and intrinsics are those of cameras.
        findings: The results so far, which are extended.
        frames: Frames that are compared; None: all.
    """
    names, group = list(rollout.bodies), rollout.group
    position, quat = rollout.values["bodies/pos"], rollout.values["bodies/quat_wxyz"]
    chosen = range(rollout.attributes.frames) if frames is None else sorted(frames)
    for number, camera_name in enumerate(rollout.cameras):
        if camera_name not in cameras:
            continue
        camera = rollout.camera(camera_name)
        findings.frames += len(chosen)
        sets = [group[f"obs/{camera_name}_{key}"] for key in ("mask", "depth", "amodal")]
        keys = ("visible_px", "amodal_px", "visible_fraction")
        counts = {key: rollout.values[f"bodies/{key}"][:, number] for key in keys}
        for picture in _pictures(sets, camera_name, chosen, len(names)):
            frame = picture.frame
            if picture.mask.max(initial=0) > len(names):
                continue  # reported with the values of the array
            yield from _check_counts(picture, {key: values[frame] for key, values in counts.items()}, names)
            painted = {
                body: _paint(model, name, position[frame, body], quat[frame, body], camera)
                for body, name in enumerate(names)
                if name in model.body_splats
            }
            yield from _check_bodies(picture, painted, names, findings)


def _pictures(sets: list[Node], camera: str, frames: Sequence[int], bodies: int) -> Iterator[_Picture]:
    """Read pictures of a camera from its masks, depths and amodal masks, in the blocks of the file."""
    step = sets[0].chunks[0] if sets[0].chunks else len(sets[0])
    for block in sorted({frame // step for frame in frames}):
        wanted = [frame for frame in frames if frame // step == block]
        first, last = wanted[0], wanted[-1] + 1
        masks, depths, amodals = (item[first:last] for item in sets)
        for frame in wanted:
            amodal = amodals[frame - first]
            alone = [amodal >> amodal.dtype.type(body) & 1 > 0 for body in range(bodies)]
            mask, depth = masks[frame - first], depths[frame - first]
            yield _Picture(camera=camera, frame=frame, mask=mask, depth=depth, amodal=alone)


def _check_counts(picture: _Picture, listed: dict[str, np.ndarray], names: list[str]) -> Iterator[Fault]:
    """Check `visible_px` and `amodal_px` of `bodies/` against the masks, and `visible_fraction` against their ratio."""
    visible = np.bincount(picture.mask.ravel(), minlength=len(names) + 1)[1 : len(names) + 1]
    whole = np.array([part.sum() for part in picture.amodal])
    fraction = np.where(whole > 0, visible / np.maximum(whole, 1), 0.0)
    found = {"visible_px": visible, "amodal_px": whole, "visible_fraction": fraction}
    for key, values in listed.items():
        for name, value, expected in zip(names, values, found[key], strict=True):
            if not abs(value - expected) <= 1e-6:
                text = f"bodies/{key}: frame {picture.frame}, camera {picture.camera}, body '{name}': {value:g}; "
                text += f"the masks have {expected:g}."
                yield picture.fault("labels", text, float(value), float(expected), name)


def _check_bodies(
    picture: _Picture, painted: dict[int, _Painted], names: list[str], findings: PictureFindings
) -> Iterator[Fault]:
    """Compare mask, depth and amodal mask of each body with its projected spheres; yield one fault for each at most."""
    for body, spheres in painted.items():
        others = [other for index, other in painted.items() if index != body]
        whole = _compare_amodal(spheres, picture.amodal[body], findings)
        fault = _compare(spheres, others, picture.mask == body + 1, picture.depth, findings) or whole
        if fault is not None:
            check, text, value, limit = fault
            place = f"obs/{picture.camera}, frame {picture.frame}, body '{names[body]}'"
            yield picture.fault(check, f"{place}: {text}", value, limit, names[body])


def _paint(model: Model, name: str, position: np.ndarray, quat: np.ndarray, camera: Camera) -> _Painted:
    """Project a body's spheres from the labels, without the renderer, so that its conventions are tested, too.

    Each sphere in front of the camera is drawn as a disc, the nearest last. OpenCV's pixel centres are integers.
    """
    splats = model.body_splats[name]
    solid = np.asarray(splats.opacities) > SOLID
    points = np.asarray(splats.means, float)[solid] @ rotation_matrix(quat).T + position
    scales = np.asarray(splats.scales, float)[solid]
    pixels, depths = camera.project(points)
    radii = SPHERE_RADIUS * scales * float(camera.K[0, 0]) / np.maximum(depths, 1e-9)
    front = np.isfinite(pixels).all(1) & (depths > 0)
    front &= ((pixels > -radii[:, None]) & (pixels < np.array([camera.width, camera.height]) + radii[:, None])).all(1)
    order = np.flatnonzero(front)[np.argsort(-depths[front], kind="stable")]
    shift = 4
    centres = np.clip((pixels[order] - 0.5) * 2**shift, -(2**20), 2**20).round().astype(int)
    painted = np.zeros((camera.height, camera.width), np.float32)
    for (x, y), radius, depth in zip(
        centres.tolist(), (radii[order] * 2**shift).round().astype(int).tolist(), depths[order].tolist(), strict=True
    ):
        cv2.circle(painted, (x, y), min(radius, 2**20), depth, -1, shift=shift)
    return _Painted(painted, float(np.median(scales)) if len(scales) else 0.0)


def _compare(
    body: _Painted,
    others: list[_Painted],
    mask: np.ndarray,
    depth: np.ndarray,
    findings: PictureFindings,
) -> tuple[str, str, float, float] | None:
    """Compare a body's mask and depth with its projected spheres.

    Returns:
        Check, text, value and limit of the first fault; None if there is none.
    """
    area, covered = int(mask.sum()), body.covered
    reach = DEPTH_RADII * body.radius_m
    hidden = covered & ~mask & (depth > 0) & (depth < body.depth - reach)
    for other in others:
        hidden |= covered & ~mask & other.covered & (other.depth < body.depth)
    visible = covered & ~hidden
    if max(area, int(visible.sum())) < MIN_PIXELS:
        return None
    iou = float((mask & visible).sum() / (mask | visible).sum())
    if max(area, int(visible.sum())) >= MIN_IOU_PX:
        findings.iou.append(iou)
    if area >= MIN_PIXELS:
        wide = cv2.dilate(covered.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)
        inside = float((mask & wide).sum() / area)
        findings.inside.append(inside)
        if visible.any():
            centres = [np.argwhere(part).mean(0) for part in (mask, visible)]
            findings.centre_px.append(float(np.linalg.norm(centres[0] - centres[1])))
        if inside < MIN_INSIDE:
            outside = 100 * (1 - inside)
            text = f"{outside:.0f} % of its mask lies outside the projected body; the pose or the camera is wrong."
            return "reprojection", text, inside, MIN_INSIDE
    if max(area, int(visible.sum())) >= MIN_IOU_PX and iou < MIN_IOU:
        text = f"mask and projected body overlap by {iou:.2f} (IoU); at least {MIN_IOU} is required. "
        text += "The pose or the mask is wrong."
        return "reprojection", text, iou, MIN_IOU
    both = mask & covered
    if both.sum() >= MIN_PIXELS:
        error = float(np.median(np.abs(depth[both] - body.depth[both])))
        findings.depth_m.append(error)
        if not error <= reach:
            text = f"its depth differs from that of its pose by {error:.3g} m (median); {reach:.2g} m is allowed."
            return "depth", text, error, reach
    return None


def _compare_amodal(
    body: _Painted, amodal: np.ndarray, findings: PictureFindings
) -> tuple[str, str, float, float] | None:
    """Compare a body's amodal mask with all its projected spheres; the result is as in `_compare`."""
    covered = body.covered
    if max(int(covered.sum()), int(amodal.sum())) < MIN_IOU_PX:
        return None
    iou = float((amodal & covered).sum() / (amodal | covered).sum())
    findings.amodal_iou.append(iou)
    if iou >= MIN_IOU:
        return None
    text = f"amodal mask and pose overlap by {iou:.2f} (IoU); at least {MIN_IOU} is required."
    return "amodal mask", text, iou, MIN_IOU


def picture_facts(findings: PictureFindings) -> dict[str, Any]:
    """Return the results of the comparison for the report."""
    facts: dict[str, Any] = {}
    if findings.iou:
        facts["mask_iou_median"] = float(np.median(findings.iou))
        facts["mask_iou_min"] = float(min(findings.iou))
    if findings.inside:
        facts["mask_inside_projection_min"] = float(min(findings.inside))
        facts["mask_centre_error_px_median"] = float(np.median(findings.centre_px)) if findings.centre_px else 0.0
    if findings.depth_m:
        facts["depth_error_m_median"] = float(np.median(findings.depth_m))
        facts["depth_error_m_max"] = float(max(findings.depth_m))
    if findings.amodal_iou:
        facts["amodal_iou_median"] = float(np.median(findings.amodal_iou))
    return facts
