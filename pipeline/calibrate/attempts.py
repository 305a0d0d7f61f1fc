"""Attempts of structure from motion with different settings, until a model passes its self-check."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets.capture.images import read_rgb
from ...datasets.io.processors import processors
from ...schemas import CalibrateConfig, NotConvergedError
from ...schemas.calibration import CalibrationAttempt, ImageVerdict, PairFigures, SelfCheckFigures
from .camera_models import FIRST_TRIED, LADDER, richer, supported
from .center_uncertainty import center_stds, focal_stds
from .colmap.features import SfmSettings, build_database, exif_focals_px, feature_counts, read_pairs
from .colmap.mapping import (
    Mapped,
    adjusted,
    adjusts_without_blas,
    map_database,
    triangulated,
    with_focal_lengths,
    with_principal_points,
    without_outliers,
)
from .consistency_check import SelfCheck, check_model
from .focal_prior import EXIF_STD, FocalLength, focal_lengths
from .photos import Inputs, video_of
from .pose_posterior import principal_points
from .reconstruction import SfmModel, VerifiedPair
from .track_alignment import aligned
from .turned_on_the_spot import turned_on_the_spot
from .turntable.cameras import TurntableCameras, on_turntable
from .turntable.motion import TurntableMotion

MIN_PHOTOS = 3
"""Minimum number of photos, and of registered ones."""
MIN_REGISTERED_FRACTION = 0.5
"""Minimum fraction of registered photos; below it the calibration fails."""
_LOW_PEAK_THRESHOLD = 0.002  # conventions: worked for weak texture
_THOROUGH_TRIALS = 10000  # COLMAP's default: finds pairs with few true matches
_TIGHT_RATIO = 0.7  # Lowe's test for repeated texture
_ALIGN_ABOVE = 0.001
"""Standard deviation of an optical centre, as a fraction of the extent of all, above which places of points in the
photos are aligned to each other: before one is so uncertain that a warning is given."""
_MIDDLE_STEPS = 3
"""Most steps of the principal points."""
_RICHEST_ON_TURNTABLE = "RADIAL"
"""Tangential distortion can hardly be told from a rotation of the camera where the camera always stands alike."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Result of an attempt."""

    model: SfmModel
    """The largest connected model."""
    camera_model: str
    """Camera model that its observations support."""
    check: SelfCheck
    """Self-check of that model."""
    models: tuple[SfmModel, ...]
    """All connected models."""
    pairs: tuple[VerifiedPair, ...]
    """Verified pairs of images."""
    features: dict[str, int]
    """Number of features by image."""
    focals: dict[str, FocalLength]
    """Focal lengths of the cameras with EXIF data, by camera."""
    motion: TurntableMotion | None
    """The turntable that the poses of the model are on; None where cameras are free."""
    noise_px: dict[str, float]
    """Noise of observations by image, before some were dropped."""
    moved: dict[str, tuple[float, float]]
    """How far that moved each centre, of the extent of all, and turned each camera [rad]; empty on a turntable."""
    attempt: int
    """Number of the attempt."""


def search(folder: Path, inputs: Inputs, config: CalibrateConfig) -> tuple[Candidate, list[CalibrationAttempt]]:
    """Try settings until a model passes its self-check; if it lacks images, try once more with more features.

    Args:
        folder: Empty directory for the databases and models of COLMAP.
        inputs: The images.
        config: Settings of the stage.

    Returns:
        The attempt whose model has the most photos, and figures of all attempts.

    Raises:
        NotConvergedError: If no model passes, or too few photos are registered.
    """
    attempts: list[CalibrationAttempt] = []
    passed: list[Candidate] = []
    last: Candidate | None = None
    built: SfmSettings | None = None
    for settings in _plan(config):
        if passed and len(passed[0].model.T_cam_world) == len(inputs.sources):
            break
        incomplete = bool(passed) or (built is not None and (last is None or last.check.passed))
        if incomplete and built is not None and settings.features == built.features:
            continue  # Another seed registers no more images, but more features may.
        second_try = bool(passed)
        candidate, attempt = _attempt(folder, inputs, settings, built, len(attempts), config.turntable)
        attempts.append(attempt)
        built, last = settings, candidate
        if candidate is not None and candidate.check.passed:
            passed.append(candidate)
        if second_try:
            break
    best = max(passed, key=lambda candidate: _rank(candidate, inputs), default=None)
    if best is None or photo_count(best.model, inputs) < _needed(inputs):
        raise _not_converged(inputs, attempts, best, last)
    if turned_on_the_spot(best.model, best.pairs):
        raise NotConvergedError(
            "The photos were taken from one place: turns of the camera alone explain all matches, and tell no depth.",
            "photos from many places around the object.",
            "walk around the object, or turn it before the camera on a turntable; turning on the spot shows nothing.",
        )
    attempts[best.attempt] = attempts[best.attempt].model_copy(update={"outcome": "taken"})
    return best, attempts


def _plan(config: CalibrateConfig) -> list[SfmSettings]:
    """Return the settings of the attempts: other seeds first, then other matching, then more features."""
    base = SfmSettings(seed=config.seed, max_features=config.max_features, max_image_size=config.max_image_size)
    more = replace(
        base,
        max_features=2 * config.max_features,
        max_image_size=2 * config.max_image_size,
        peak_threshold=_LOW_PEAK_THRESHOLD,
        verification_trials=_THOROUGH_TRIALS,
    )
    plan = [
        base,
        replace(base, seed=config.seed + 1),
        replace(base, seed=config.seed + 2, guided_matching=True),
        replace(more, seed=config.seed + 3),
        replace(more, seed=config.seed + 4, guided_matching=True, max_ratio=_TIGHT_RATIO),
    ]
    further = config.retries + 1 - len(plan)
    plan += [replace(plan[3 + k % 2], seed=config.seed + 5 + k) for k in range(max(further, 0))]
    return plan[: config.retries + 1]


def _attempt(
    folder: Path,
    inputs: Inputs,
    settings: SfmSettings,
    built: SfmSettings | None,
    number: int,
    turntable: bool | None,
) -> tuple[Candidate | None, CalibrationAttempt]:
    names = {source.image.name: source.label for source in inputs.sources}
    reuse = built is not None and built.matches == settings.matches
    database = folder / f"attempt-{number}.db"
    if reuse:
        for path in sorted(folder.glob(f"attempt-{number - 1}.*")):
            if path.is_file():
                path.rename(folder / path.name.replace(f"-{number - 1}.", f"-{number}."))
    else:
        build_database(database, inputs.root, [source.image for source in inputs.sources], settings)
    exif_px = exif_focals_px(database)
    models, camera_model = _models(database, inputs, settings.seed)
    focals: dict[str, FocalLength] = {}
    if models:
        models[0] = _with_principal_points(models[0], camera_model, inputs, settings.seed)
        models[0], focals = _with_exif(models[0], camera_model, exif_px, inputs, settings.seed)
    pairs = tuple(
        replace(pair, image_a=names[pair.image_a], image_b=names[pair.image_b]) for pair in read_pairs(database)
    )
    candidate = None
    if models:
        features = {names[name]: count for name, count in feature_counts(database).items()}
        named = tuple(one.model().renamed(names) for one in models)
        found = None if turntable is False else _on_turntable(named, pairs, inputs, focals)
        if found is not None:
            named, camera_model = (found.model, *named[1:]), found.camera_model
        candidate = Candidate(
            model=named[0],
            camera_model=camera_model,
            check=check_model(named[0], pairs),
            models=named,
            pairs=pairs,
            features=features,
            focals=focals,
            motion=found.motion if found else None,
            noise_px={names[image]: noise for image, noise in models[0].noise_px.items()},
            # the poses of a turntable are held by its motion
            moved={} if found else {names[image]: moves for image, moves in models[0].moved.items()},
            attempt=number,
        )
    return candidate, _attempt_figures(settings, candidate)


def _models(database: Path, inputs: Inputs, seed: int) -> tuple[list[Mapped], str]:
    """Return the connected models of the camera model that registers most images, the largest refined; and which it is.

    The mapping tries camera models from simple ones on until all images are registered. Of the largest model, cameras
    are then as rich as its observations support.
    """
    best: list[Mapped] = []
    start = ""
    for model in FIRST_TRIED:
        models = limited(model, inputs)
        mapped = map_database(database, inputs.root, seed, models, inputs.known)
        if mapped and (not best or mapped[0].image_count > best[0].image_count):
            best, start = mapped, model
        if _all_known(inputs) or (best and best[0].image_count == len(inputs.sources)):
            break
    if not best:
        return [], ""
    largest, taken = _supported(best[0], start, inputs, seed)
    if largest.image_count >= MIN_REGISTERED_FRACTION * len(inputs.sources) and _uncertain(largest, taken, inputs):
        largest, taken = _aligned(largest, taken, best[0], start, database, inputs, seed)
    return [largest, *best[1:]], taken


def _supported(mapped: Mapped, start: str, inputs: Inputs, seed: int) -> tuple[Mapped, str]:
    """Return a model without outliers, with cameras as rich as its observations support, and how rich they are.

    Principal points are moved first: what a wrong one moves at the borders of photos would be taken for outliers, and
    what is left would confirm it.
    """
    tried = richer(start, "SIMPLE_PINHOLE" if _all_known(inputs) else "OPENCV")
    mapped = _with_principal_points(mapped, start, inputs, seed)
    together = min(processors(), len(tried)) if adjusts_without_blas(mapped) else 1
    with ThreadPoolExecutor(together) as pool:  # COLMAP adjusts each in one thread
        found = pool.map(lambda model: adjusted(mapped, limited(model, inputs), inputs.known, seed), tried)
        steps = dict(zip(tried, found, strict=True))
    free = len(set(mapped.names.values()) - set(inputs.known))
    taken = supported([(model, step.residuals_px()) for model, step in steps.items()], free)
    return without_outliers(steps[taken], inputs.known, seed), taken


def _uncertain(mapped: Mapped, camera_model: str, inputs: Inputs) -> bool:
    """Return whether the centres are so uncertain that finer places of the points are worth their time.

    A photo that is alone with its camera is as uncertain as its principal point, whatever its places.
    """
    model = mapped.model()
    photos = Counter(model.image_camera.values())
    stds = center_stds(model, estimated(camera_model, model, inputs))
    return any(std > _ALIGN_ABOVE for image, std in stds.items() if photos[model.image_camera[image]] > 1)


def _aligned(
    largest: Mapped, taken: str, mapped: Mapped, start: str, database: Path, inputs: Inputs, seed: int
) -> tuple[Mapped, str]:
    """Return what `_supported` does, of points whose places in the photos are aligned to each other.

    With the cameras of the first round the points of all matches are found anew, and looked for in further photos. A
    model that would lose a photo by that stays as it was.
    """
    photos = {name: _brightness(inputs.root / name) for name in mapped.model().T_cam_world}
    for further in (False, True):
        if further:
            mapped = triangulated(largest, database, inputs.root, seed)
        if not _all_seen(mapped):
            break
        adjusted_first = adjusted(mapped, limited(start, inputs), inputs.known, seed)
        finer = adjusted_first.with_observations(aligned(adjusted_first.model(), photos, further))
        finer, lens = _supported(finer, start, inputs, seed)
        if not _all_seen(finer):
            break
        largest, taken = finer, lens
    return largest, taken


def _all_seen(mapped: Mapped) -> bool:
    """Return whether each registered image sees points."""
    return all(len(seen) for _, seen in mapped.model().observations.values())


def _brightness(photo: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(read_rgb(photo), cv2.COLOR_RGB2GRAY), np.uint8)


def _with_principal_points(mapped: Mapped, camera_model: str, inputs: Inputs, seed: int) -> Mapped:
    """Return a model whose principal points are off the middle as far as the observations say so."""
    models = estimated(camera_model, mapped.model(), inputs)
    for _ in range(_MIDDLE_STEPS):
        points = principal_points(mapped.model(), models)
        if not points:
            break
        mapped = with_principal_points(mapped, points, inputs.known, seed)
    return mapped


def _with_exif(
    mapped: Mapped, camera_model: str, exif_px: dict[str, float], inputs: Inputs, seed: int
) -> tuple[Mapped, dict[str, FocalLength]]:
    """Return a model whose focal lengths heed the EXIF data too, as far as the matches leave them open, and these."""
    model = mapped.model()
    models = estimated(camera_model, model, inputs)
    if not set(models) & set(exif_px):
        return mapped, {}
    matches_px = {camera: model.cameras[camera].focal_px for camera in models}
    focals = focal_lengths(exif_px, matches_px, focal_stds(model, models))
    combined = {camera: focal.combined_px for camera, focal in focals.items() if focal.agree}
    return with_focal_lengths(mapped, combined, inputs.known, seed) if combined else mapped, focals


def _on_turntable(
    models: Sequence[SfmModel],
    pairs: Sequence[VerifiedPair],
    inputs: Inputs,
    focals: dict[str, FocalLength],
) -> TurntableCameras | None:
    """Return the cameras of a turntable, where the matches support one."""
    cameras = {source.label: source.image.camera for source in inputs.sources}
    lenses = {
        name: {camera: model for camera, model in limited(name, inputs).items() if camera not in inputs.known}
        for name in (LADDER[:1] if _all_known(inputs) else LADDER[: LADDER.index(_RICHEST_ON_TURNTABLE) + 1])
    }
    exif = {camera: (focal.exif_px, EXIF_STD) for camera, focal in focals.items() if focal.agree}
    return on_turntable(models, pairs, cameras, lenses, exif)


def estimated(camera_model: str, model: SfmModel, inputs: Inputs) -> dict[str, str]:
    """Return the camera model of each camera of a model whose intrinsics were estimated."""
    used = set(model.image_camera.values()) - set(inputs.known)
    return {camera: name for camera, name in limited(camera_model, inputs).items() if camera in used}


def limited(model: str, inputs: Inputs) -> dict[str, str]:
    """Return a camera model by camera, no richer than the camera's photos allow."""
    return {camera: min(model, richest, key=LADDER.index) for camera, richest in inputs.richest.items()}


def _all_known(inputs: Inputs) -> bool:
    return all(source.image.camera in inputs.known for source in inputs.sources)


def _attempt_figures(settings: SfmSettings, candidate: Candidate | None) -> CalibrationAttempt:
    outcome = "no_model" if candidate is None else "passed" if candidate.check.passed else "self_check_failed"
    return CalibrationAttempt(
        seed=settings.seed,
        max_features=settings.max_features,
        max_image_size=settings.max_image_size,
        peak_threshold=settings.peak_threshold,
        guided_matching=settings.guided_matching,
        max_ratio=settings.max_ratio,
        models=len(candidate.models) if candidate else 0,
        camera_model=candidate.camera_model if candidate else "",
        registered=len(candidate.model.T_cam_world) if candidate else 0,
        points=len(candidate.model.points) if candidate else 0,
        reprojection_error_px=candidate.model.reprojection_error_px if candidate else None,
        self_check=check_figures(candidate.check) if candidate else None,
        outcome=outcome,
    )


def check_figures(check: SelfCheck) -> SelfCheckFigures:
    """Return the figures of a self-check for `calibration.json`."""
    worst = check.worst
    return SelfCheckFigures(
        passed=check.passed,
        pairs=len(check.pairs),
        strong_pairs=len(check.strong),
        worst=worst
        and PairFigures(
            images=(worst.image_a, worst.image_b), inliers=worst.inliers, consistent=round(worst.consistent, 4)
        ),
        images_without_strong_pair=check.images_without_strong_pair,
    )


def _rank(candidate: Candidate, inputs: Inputs) -> tuple[int, int, int]:
    return photo_count(candidate.model, inputs), len(candidate.model.T_cam_world), -candidate.attempt


def photo_count(model: SfmModel, inputs: Inputs) -> int:
    """Return the number of photos that a model registers, without frames of videos."""
    return sum(label in model.T_cam_world for label in photo_labels(inputs))


def photo_labels(inputs: Inputs) -> list[str]:
    """Return the labels of the photos, without frames of videos."""
    return [source.label for source in inputs.sources if video_of(source.label) is None]


def _needed(inputs: Inputs) -> int:
    return max(MIN_PHOTOS, int(np.ceil(MIN_REGISTERED_FRACTION * len(photo_labels(inputs)))))


def _not_converged(
    inputs: Inputs, attempts: Sequence[CalibrationAttempt], best: Candidate | None, last: Candidate | None
) -> NotConvergedError:
    photos = len(photo_labels(inputs))
    rejected = [attempt for attempt in attempts if attempt.outcome == "self_check_failed"]
    if best is None and rejected:
        worst = rejected[0].self_check.worst if rejected[0].self_check else None
        where = ""
        if worst:
            where = (
                f" For example {worst.images[0]} and {worst.images[1]} share {worst.inliers} verified matches, of "
                f"which {100 * worst.consistent:.0f} % agree with the cameras."
            )
        return NotConvergedError(
            f"All {len(rejected)} camera models contradict their own matches ({len(attempts)} attempts).{where}",
            "models in which every pair of images with 200 or more verified matches is at least 50 % consistent.",
            "remove blurred photos and those in which something moved; repeated or symmetric texture can cause this: "
            "put an object or printed pattern with unique texture next to it, and photograph in steps of 10 degrees.",
        )
    candidate = best or last
    registered = photo_count(candidate.model, inputs) if candidate else 0
    causes: dict[str, int] = {}
    for label in photo_labels(inputs):
        reason = verdict(label, candidate).reason.split(":", 1)[0] if candidate else "no model"
        if reason:
            causes[reason] = causes.get(reason, 0) + 1
    listed = ", ".join(f"{count} {reason}" for reason, count in sorted(causes.items(), key=lambda item: -item[1]))
    return NotConvergedError(
        f"{registered} of {photos} photos registered after {len(attempts)} attempts with the camera models "
        f"{', '.join(FIRST_TRIED)}. The others: {listed}.",
        f"at least {_needed(inputs)} of {photos}.",
        "take sharp photos in steps of 10 degrees or less, all around and from two heights, with the same focal "
        "length; keep textured surroundings in view; nothing may move between the photos. Known intrinsics "
        "([[calibration.intrinsics]]) help where the object fills little of the photos.",
    )


def verdict(label: str, candidate: Candidate) -> ImageVerdict:
    """Return whether an attempt registered an image, why not, and how many features and matches it has."""
    touching = [pair for pair in candidate.pairs if label in (pair.image_a, pair.image_b)]
    features, matches = candidate.features.get(label, 0), sum(len(pair.xy_a) for pair in touching)
    registered = label in candidate.model.T_cam_world
    inliers = len(candidate.model.observations[label][1]) if registered else 0
    reason = ""
    if not registered:
        part = next((model for model in candidate.models if label in model.T_cam_world), None)
        if label not in candidate.features:
            reason = "unreadable: COLMAP cannot decode it"
        elif part is not None:
            reason = f"in another part: connected to {len(part.T_cam_world) - 1} images, not to the largest part"
        elif not touching:
            reason = f"without matches: {features} features, none verified in another image"
        else:
            reason = f"without a pose: {matches} matches with {len(touching)} images, too few see reliable points"
    return ImageVerdict(
        registered=registered,
        reason=reason,
        features=features,
        matched_images=len(touching),
        matches=matches,
        inliers=inliers,
    )
