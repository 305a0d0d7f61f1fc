"""Poses against pictures: the labelled poses, projected without the renderer, have to lie on masks and depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from ..datasets.cameras import Camera
from ..datasets.loader import camera_of
from ..datasets.models import Model
from ..datasets.rollouts import Node
from .sampling import rotation_matrix
from .validate_faults import Fault

SPHERE_RADIUS = 1.177
"""A lone opaque sphere lets half of the light through at this many s: sqrt(2 ln 2)."""
SOLID = 0.1
"""Spheres of a lower opacity are not painted."""
MARGIN_PX = 2
"""A mask may reach this far beyond the projected spheres, which overlap more than one by one."""
MIN_INSIDE = 0.95
"""Fraction of a body's mask that has to lie within its projected spheres."""
MIN_IOU = 0.7
"""Least intersection over union of a body's mask and its projected spheres, but for pixels that something hides."""
MIN_IOU_PX = 80
"""Of smaller bodies the rim is most of the picture, and the intersection over union says little."""
MIN_PIXELS = 20
"""Smaller masks are not judged."""
DEPTH_RADII = 4.0
"""Median difference of a body's depth from that of its nearest projected sphere, in the radius of its spheres."""


@dataclass
class PictureFindings:
    """Measured over all pictures, a number a body and picture."""

    frames: int = 0
    iou: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    centre_px: list[float] = field(default_factory=list)
    depth_m: list[float] = field(default_factory=list)
    amodal_iou: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class _Painted:
    """The projected spheres of a body: depth (H, W) of the nearest one [m], 0 where there is none; their radius [m]."""

    depth: np.ndarray
    radius_m: float

    @property
    def covered(self) -> np.ndarray:
        return self.depth > 0


def check_pictures(demo: Node, model: Model, count: int, findings: PictureFindings) -> Iterator[Fault]:
    """Compare every body in every picture of a rollout with its pose."""
    names = [name.decode() for name in demo["bodies/names"][()]]
    position, quat = demo["bodies/pos"][()], demo["bodies/quat_wxyz"][()]
    for number, camera_name in enumerate(sorted(demo["cameras"])):
        camera = camera_of(demo[f"cameras/{camera_name}"])
        findings.frames += count
        sets = [demo[f"obs/{camera_name}_{key}"] for key in ("mask", "depth")]
        size = (camera.height, camera.width)
        if any(item.shape[1:] != size for item in sets):
            yield Fault("shape", f"obs/{camera_name}_mask: shape {sets[0].shape[1:]}; the camera has {size}.")
            continue
        amodal_set = demo[f"obs/{camera_name}_amodal"]
        counts = {key: demo[f"bodies/{key}"][:, number] for key in ("visible_px", "amodal_px", "visible_fraction")}
        for first in range(0, count, sets[0].chunks[0] if sets[0].chunks else count):
            frames = range(first, min(count, first + (sets[0].chunks[0] if sets[0].chunks else count)))
            masks, depths = (item[frames.start : frames.stop] for item in sets)
            amodals = amodal_set[frames.start : frames.stop]
            for frame in frames:
                mask, depth = masks[frame - first], depths[frame - first]
                place = f"obs/{camera_name}_mask, frame {frame}"
                if mask.max(initial=0) > len(names):
                    text = f"{place}: label {mask.max()}; there are {len(names)} bodies."
                    yield Fault("labels", text, frame, camera_name, value=float(mask.max()), limit=len(names))
                    continue
                bits = [amodals[frame - first] >> np.uint8(body) & 1 > 0 for body in range(len(names))]
                listed = {key: values[frame] for key, values in counts.items()}
                yield from _check_counts(mask, bits, listed, names, frame, camera_name)
                painted = {
                    body: _paint(model, name, position[frame, body], quat[frame, body], camera)
                    for body, name in enumerate(names)
                    if name in model.body_splats
                }
                for body, spheres in painted.items():
                    others = [other for index, other in painted.items() if index != body]
                    shown = mask == body + 1
                    whole = _compare_amodal(spheres, bits[body], findings)
                    fault = _compare(spheres, others, shown, depth, findings) or whole
                    if fault is not None:
                        check, text, value, limit = fault
                        place = f"obs/{camera_name}, frame {frame}, body '{names[body]}'"
                        yield Fault(check, f"{place}: {text}", frame, camera_name, names[body], value, limit)


def _check_counts(
    mask: np.ndarray, amodal: list[np.ndarray], listed: dict[str, np.ndarray], names: list[str], frame: int, camera: str
) -> Iterator[Fault]:
    """`bodies/visible_px` counts the pixels of the mask, `amodal_px` the bits; `visible_fraction` is their quotient."""
    visible = np.bincount(mask.ravel(), minlength=len(names) + 1)[1 : len(names) + 1]
    whole = np.array([part.sum() for part in amodal])
    fraction = np.where(whole > 0, visible / np.maximum(whole, 1), 0.0)
    found = {"visible_px": visible, "amodal_px": whole, "visible_fraction": fraction}
    for key, values in listed.items():
        for name, value, expected in zip(names, values, found[key], strict=True):
            if not abs(value - expected) <= 1e-6:
                text = f"bodies/{key}: frame {frame}, camera {camera}, body '{name}': {value:g}; "
                text += f"the masks have {expected:g}."
                yield Fault("labels", text, frame, camera, name, float(value), float(expected))


def _paint(model: Model, name: str, position: np.ndarray, quat: np.ndarray, camera: Camera) -> _Painted:
    """Project a body's spheres by the labels alone: no renderer, so that its conventions are tested too.

    A disc for each sphere in front of the camera, the nearest last. OpenCV's pixel centres are whole numbers.
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
        Of the first fault the check, what is wrong, the number and its limit; None where there is none.
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
            text = f"{outside:.0f} % of its mask lies outside the projected body; pose or camera is wrong."
            return "reprojection", text, inside, MIN_INSIDE
    if max(area, int(visible.sum())) >= MIN_IOU_PX and iou < MIN_IOU:
        text = f"mask and projected body overlap by {iou:.2f} (IoU); {MIN_IOU} is allowed. Pose or mask is wrong."
        return "reprojection", text, iou, MIN_IOU
    both = mask & covered
    if both.sum() >= MIN_PIXELS:
        error = float(np.median(np.abs(depth[both] - body.depth[both])))
        findings.depth_m.append(error)
        if not error <= reach:
            text = f"its depth is off that of its pose by {error:.3g} m (median); {reach:.2g} m is allowed."
            return "depth", text, error, reach
    return None


def _compare_amodal(
    body: _Painted, amodal: np.ndarray, findings: PictureFindings
) -> tuple[str, str, float, float] | None:
    """Compare a body's amodal mask with its projected spheres, hidden or not; returns what `_compare` does."""
    covered = body.covered
    if max(int(covered.sum()), int(amodal.sum())) < MIN_IOU_PX:
        return None
    iou = float((amodal & covered).sum() / (amodal | covered).sum())
    findings.amodal_iou.append(iou)
    if iou >= MIN_IOU:
        return None
    return "amodal mask", f"amodal mask and pose overlap by {iou:.2f}; {MIN_IOU} is allowed.", iou, MIN_IOU


def picture_facts(findings: PictureFindings) -> dict[str, Any]:
    """Return what was measured, for the report."""
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
