"""Cameras of photos of a turntable: whether photos are such, by what their matches support, and their cameras then."""

from __future__ import annotations

from collections.abc import Mapping as Map
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..bundle import POSE, all_errors_px
from ..camera_models import LENS_PARAMETERS, focal_numbers, robust_cost, supported
from ..colmap.mapping import LOSS_SCALE
from ..observation_noise import noise_px
from ..reconstruction import Array, SfmCamera, SfmModel, VerifiedPair
from .adjustment import adjusted
from .motion import TurntableMotion, turntable_motion
from .places import with_places

_KEEP_WITHIN = (4.0, 3.0)
"""As in `mapping`: residuals above this many standard deviations are taken for wrong matches, in turn."""
_WORSE = 1.5
"""Most by which the noise of the matches may grow with the photos that are placed on the rings."""
_COARSE_STEPS, _FINE_STEPS = 12, 40
_FAR = 40.0
"""Errors with the motion nearest to the poses, in units of those of free cameras, above which none is tried."""


Lenses = Map[str, Map[str, str]]
"""By camera model, from simple to rich: that of each camera whose intrinsics are estimated, no richer than its photos
allow."""
Focals = Map[str, tuple[float, float]]
"""Focal length [px] and its relative standard deviation of cameras, from their EXIF data."""


@dataclass(frozen=True)
class TurntableCameras:
    """A model of a turntable, and its motion."""

    model: SfmModel
    """The model, with the axis of the turntable along z."""
    motion: TurntableMotion
    """Its motion."""
    camera_model: str
    """The simplest camera model that no richer one beats, of cameras on a turntable."""


def on_turntable(
    models: Sequence[SfmModel],
    pairs: Sequence[VerifiedPair],
    cameras: Map[str, str],
    lenses: Lenses,
    focals: Focals,
) -> TurntableCameras | None:
    """Return the cameras of a turntable, where the photos are of one.

    The motion of a turntable is taken where cameras that are free beat it by less than their further numbers cost under
    the Bayesian information criterion (Schwarz, 1978), ln(n) each: the test by which camera models are chosen. Photos
    that no free camera was found for are then placed on its rings.

    Args:
        models: Connected models with free cameras, the largest first.
        pairs: Verified pairs of all photos.
        cameras: Name of the camera of each photo.
        lenses: Camera models to choose from.
        focals: What EXIF data say.
    """
    found = [one for model in models[:2] if (one := _constrained(model, lenses, focals)) is not None]
    if not found:
        return None
    complete = [_completed(one, pairs, cameras, lenses, focals) for one in found]
    return max(complete, key=lambda one: len(one.model.T_cam_world))


def _constrained(model: SfmModel, lenses: Lenses, focals: Focals) -> TurntableCameras | None:
    start = turntable_motion(model)
    if start is None:
        return None
    free = all_errors_px(model)
    noise = noise_px(free)
    turned, motion = start
    # from afar, under a loss as wide as the start is wrong
    wide = noise_px(all_errors_px(motion.placed(turned)))
    if wide > _FAR * noise:
        return None
    richest = _present(lenses[list(lenses)[-1]], turned)
    weights = _weights(turned, richest, focals, noise)
    turned, motion = adjusted(turned, motion, richest, LOSS_SCALE * wide, weights, _COARSE_STEPS)
    turned, motion = adjusted(turned, motion, richest, LOSS_SCALE * noise, weights, _FINE_STEPS)
    if _beaten(turned, motion, free, noise):
        return None
    return _with_lens(turned, motion, lenses, focals)


def _beaten(model: SfmModel, motion: TurntableMotion, free_px: Array, noise: float) -> bool:
    """Return whether free cameras, with errors `free_px` (observation,), are worth their further numbers."""
    saved = POSE * len(model.T_cam_world) - motion.numbers
    gain = robust_cost(all_errors_px(model), noise) - robust_cost(free_px, noise)
    return bool(gain > saved * np.log(2 * len(free_px)))


def _with_lens(model: SfmModel, motion: TurntableMotion, lenses: Lenses, focals: Focals) -> TurntableCameras:
    """Return a model with the simplest lens that no richer one beats: free cameras may have needed a rich one."""
    noise = noise_px(all_errors_px(model))
    tried = {}
    for name, wanted in lenses.items():
        own = _present(wanted, model)
        plain = replace(model, cameras={key: _plain(camera, own.get(key)) for key, camera in model.cameras.items()})
        weights = _weights(model, own, focals, noise)
        tried[name] = adjusted(plain, motion, own, LOSS_SCALE * noise, weights, _FINE_STEPS)
    cameras = len(_present(lenses[list(lenses)[-1]], model))
    taken = supported([(name, all_errors_px(one)) for name, (one, _) in tried.items()], cameras)
    best, moved = tried[taken]
    return TurntableCameras(best, moved, taken)


def _plain(camera: SfmCamera, lens: str | None) -> SfmCamera:
    """Return a camera without what a camera model does not have."""
    if lens is None:
        return camera
    focals = focal_numbers(lens)
    k1, k2, p1, p2 = (*camera.distortion[: LENS_PARAMETERS[lens] - focals], 0.0, 0.0, 0.0, 0.0)[:4]
    fx, fy = (camera.fx, camera.fy) if focals == 2 else (camera.focal_px, camera.focal_px)
    return replace(camera, fx=fx, fy=fy, distortion=(k1, k2, p1, p2))


def _present(wanted: Map[str, str], model: SfmModel) -> dict[str, str]:
    return {camera: wanted[camera] for camera in model.cameras if camera in wanted}


def _completed(
    found: TurntableCameras, pairs: Sequence[VerifiedPair], cameras: Map[str, str], lenses: Lenses, focals: Focals
) -> TurntableCameras:
    """Return a model with the photos that its rings have room for, where these do not contradict it."""
    before = noise_px(all_errors_px(found.model))
    model, motion = with_places(found.model, found.motion, pairs, cameras)
    if motion is found.motion:
        return replace(found, model=_with_error(found.model))
    wanted = _present(lenses[found.camera_model], model)
    for limit in (None, *_KEEP_WITHIN):
        noise = noise_px(all_errors_px(model))
        if limit is not None:
            model = _without_outliers(model, limit * noise)
        weights = _weights(model, wanted, focals, noise)
        model, motion = adjusted(model, motion, wanted, LOSS_SCALE * noise, weights, _FINE_STEPS)
    if noise_px(all_errors_px(model)) > _WORSE * before:
        return replace(found, model=_with_error(found.model))
    best = _with_lens(model, motion, lenses, focals)
    return replace(best, model=_with_error(best.model))


def _weights(model: SfmModel, wanted: Map[str, str], focals: Focals, noise: float) -> dict[str, tuple[float, float]]:
    """Return focal lengths [px] and their weights, in units of squared residuals [1]."""
    known = {camera: focals[camera] for camera in wanted if camera in focals}
    return {camera: (focal, (noise / (std * focal)) ** 2) for camera, (focal, std) in known.items()}


def _without_outliers(model: SfmModel, limit_px: float) -> SfmModel:
    """Drop observations with larger errors, and points that fewer than two are left of."""
    good = {image: model.errors_px(image) <= limit_px for image in model.T_cam_world}
    kept = {image: (xy[good[image]], seen[good[image]]) for image, (xy, seen) in model.observations.items()}
    count = np.bincount(np.concatenate([seen for _, seen in kept.values()]), minlength=len(model.points))
    return replace(model, observations=kept).with_points(count >= 2)


def _with_error(model: SfmModel) -> SfmModel:
    return replace(model, reprojection_error_px=float(all_errors_px(model).mean()))
