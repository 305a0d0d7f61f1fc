"""Consistency of gravity, ground, shapes and measured motion of a capture.

No convention is checked, such as z up, but whether the parts agree: measured accelerations in the air with gravity, the
distance of the bodies from the ground with their shapes, gravity with the ground's normal. A capture is refused only if
one mistake (of `unit_mistakes`) explains its motion much better than the capture as it is written, with room for every
effect that forces and sensors have. What is off otherwise is a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...schemas import Body, CaptureManifest, Ground, InputDataError
from ..shapes.meshes import primitive_properties
from .folder import CaptureFolder
from .handedness import mirrored_axes
from .surface_distance import surface_distance
from .tracked_motion import TrackedMotion, outline_of, tracked_motions
from .unit_mistakes import LENGTHS, ORDERS, Correction, frame_corrections, ground_correction, unit_corrections

Array = NDArray[np.float64]

AS_WRITTEN = Correction()
EFFECTS_SHARE = 0.5
"""Largest difference of an acceleration in the air from gravity, as a share of gravity, that effects are allowed."""
EXACT_SHARE = 0.06
"""The same after the correction of a mistake that forces in the air could be taken for."""
MEASURED_SHARE = 0.2
"""Largest standard error of an acceleration, as a share of it or of gravity, of windows that count."""
DEPTH_SHARE, TOUCH_SHARE, TILT = 0.5, 0.3, 0.1
"""Largest depth under the ground and largest height of a contact, as shares of the body's size, and both additionally
as a share of the distance from the origin: a tilted frame is an effect."""
UNKNOWN_SIZE_M = 0.3
"""Size of a body whose shape is not known, for its depth under the ground [m]."""
WRONG, ADRIFT = 0.4, 0.6
"""A capture can be refused if this share of the windows is unexplained: the body is under the ground, or neither falls
nor touches anything; or if it does not fall in this share of those in which nothing touches it."""
SUSPECTED_WRONG, STEEP_COSINE = 0.1, 0.5
"""The first share where gravity and the ground's normal have an angle whose cosine is below the second number: no ramp
is as steep as 60 degrees."""
LEFT_BURIED, LEFT_ADRIFT, MUCH_BETTER = 0.05, 0.2, 3.0
"""Most that a correction may leave of either, and the factor by which their sum has to become smaller."""
FEWEST, KEPT = 4, 0.7
"""Fewest windows that show what a correction claims, and share of the windows that have to remain precise enough."""
CONFIRMED, CONFIRMED_SHARE = 0.15, 0.15
"""Gravity is right if this share of all windows has its acceleration, within the second share of gravity."""
FALLS, FALLS_FEWEST, FALLS_NEVER = 0.3, 20, 0.01
"""A correction explains the motion, whatever else it leaves, with which a body falls in the first share of all windows,
of so many at least, where as written it has the acceleration of gravity in no more than the last share of them."""
LYING_SHARE, LYING_TIGHT, LYING_FRAMES = 0.12, 0.04, 0.15
"""Of a box or mesh that lies on the ground: depth of its lowest point, as a share of its size, that a wrong orientation
causes in at least the last share of the frames, and the one that a right orientation leaves."""
ALIKE = 0.03
"""Difference between corrections, in shares of the motion and of gravity, below which both are named."""
OFF = 0.1
"""Share of gravity, and of the frames, from which on there is a warning."""
FARTHEST_COM = 1.5
"""Largest distance of a centre of mass from the origin of the body frame, in sizes of the shape."""
SOLID_KG_M3 = (0.05, 23000.0)
"""Mean densities of bodies [kg/m3], from a balloon's skin and the hot air in it to osmium's."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How much of the motion is explained under a correction, in windows of all tracks."""

    buried: float
    """Share of the windows in which a body is under the ground."""
    adrift: float
    """Share of the flights in which it does not fall."""
    misfit: float
    """Median difference of the acceleration in flights from gravity, as a share of gravity."""
    flights: int
    """Number of windows in which nothing touches the body."""
    lying: int
    """Number of windows in which its lowest point is on the ground and it does not fall."""
    touching: int
    """Number of windows in which it touches something and does not fall."""
    like_gravity: float
    """Share of all windows, wherever the body is, with the acceleration of gravity."""
    windows: int
    """Number of windows."""

    @property
    def wrong(self) -> float:
        """Share of the windows in which a body is under the ground, or neither falls nor touches anything."""
        return self.buried + self.adrift * self.flights / max(self.windows, 1)

    def contradicts(self, suspected: bool) -> bool:
        """Return whether the motion contradicts the capture, or one whose gravity and ground do not go together."""
        most = SUSPECTED_WRONG if suspected else WRONG
        return self.wrong >= most or (self.flights >= FEWEST and self.adrift >= ADRIFT)

    def explains(self, written: Agreement, correction: Correction) -> bool:
        """Return whether motion is seen that the correction explains, and much better than as it is written."""
        if correction.changes_gravity and written.like_gravity >= CONFIRMED:
            return False
        good = self.buried <= LEFT_BURIED and self.adrift <= LEFT_ADRIFT
        if good and MUCH_BETTER * (self.wrong + self.adrift) <= written.wrong + written.adrift:
            return self.falling >= FEWEST or self._lies_instead(written, correction)
        # what bounces on a ground that is not in the capture falls between the bounces, which nothing else imitates
        falls = min(self.falling, self.like_gravity * self.windows) >= FALLS * max(written.windows, FALLS_FEWEST)
        return falls and self.buried <= LEFT_BURIED and written.like_gravity <= FALLS_NEVER

    @property
    def falling(self) -> float:
        """Number of the windows in which a body falls."""
        return (1 - self.adrift) * self.flights

    def _lies_instead(self, written: Agreement, correction: Correction) -> bool:
        """Return whether bodies that never fall lie on the ground after a correction, and cannot be as written.

        What is adrift as written may hang, be held, or stand on what is not in the capture: so no other frame of a
        motion that never falls is better, and of other units only one in which it lies on the ground exactly.
        """
        impossible = written.buried >= WRONG or correction.length <= 0.01
        lies = self.lying >= FEWEST and self.lying >= 0.8 * self.touching and self.windows >= KEPT * written.windows
        return lies and impossible and not correction.changes_fall


def check_consistency(capture: CaptureFolder) -> list[str]:
    """Compare the parts of a capture with each other, and return warnings.

    Raises:
        InputDataError: If one mistake in units, axes or signs explains them much better.
    """
    manifest, where = capture.manifest, f"{capture.root / 'capture.toml'}"
    motions = tracked_motions(capture)
    _check_densities(capture, where)
    if not motions:
        check_gravity(manifest.world.gravity_m_s2, manifest.world.ground, where)
        return []
    written = agreement(manifest, motions, AS_WRITTEN)
    found = _better_corrections(manifest, motions, written)
    if found:
        raise _fault(capture, _contradiction(written), found)
    if written.flights < FEWEST:
        check_gravity(manifest.world.gravity_m_s2, manifest.world.ground, where)
    wrong_order = _better_order(manifest, motions)
    if wrong_order is not None:
        raise _fault(capture, "a body that lies on the ground reaches into it", [wrong_order])
    exchange = mirrored_axes(manifest, motions)
    if exchange is not None:
        raise _fault(
            capture, "what the ground does to the body's path contradicts what it does to its turns", [exchange]
        )
    return list(_warnings(manifest, motions, where))


def agreement(manifest: CaptureManifest, motions: Sequence[TrackedMotion], correction: Correction) -> Agreement:
    """Return how much of the motion gravity, ground and shapes explain after a correction."""
    gravity = np.array(correction.gravity or manifest.world.gravity_m_s2)
    strength = max(float(np.linalg.norm(gravity)), 1e-12)
    counts = np.zeros(7, int)
    away = []
    for motion in motions:
        scale = correction.length / correction.time**2
        error = motion.windows.std_error * scale
        size = np.linalg.norm(motion.windows.acceleration, axis=1) * scale
        off = np.linalg.norm(motion.windows.acceleration * scale - gravity, axis=1)
        usable = error <= MEASURED_SHARE * np.maximum(size, strength)
        falls = off <= (EXACT_SHARE if correction.exact else EFFECTS_SHARE) * strength + 3 * error
        deep, touches, lies = _contact(manifest, motion, correction)
        free = ~deep & ~touches
        like = off <= CONFIRMED_SHARE * strength + error
        away.append(off[usable & free])
        parts = (np.ones_like(usable), deep, free, free & falls, lies & ~falls, touches & ~falls, like)
        counts += [np.count_nonzero(usable & part) for part in parts]
    windows, buried, flights, falling, lying, touching, like_gravity = counts.tolist()
    return Agreement(
        buried=buried / max(windows, 1),
        adrift=1 - falling / max(flights, 1) if flights else 0.0,
        misfit=float(np.median(np.concatenate(away))) / strength if flights else 0.0,
        flights=flights,
        lying=lying,
        touching=touching,
        like_gravity=like_gravity / max(windows, 1),
        windows=windows,
    )


def _contact(
    manifest: CaptureManifest, motion: TrackedMotion, correction: Correction
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return in which windows a body is under the ground, may touch something, and lies on the ground.

    The first two leave room for a tilted frame and for errors of shape and ground; the third does not.
    """
    deep = touches = lies = np.zeros(len(motion.windows.first), bool)
    gap = clearance(manifest, motion, correction)
    if gap is not None:
        size = UNKNOWN_SIZE_M if motion.outline is None else correction.shape * motion.outline.size_m
        reach = TILT * correction.length * np.abs(motion.track.position_m).max(initial=0.0)
        slack = reach + 4 * correction.length * motion.windows.noise
        low, _ = motion.windows.extremes(gap)
        deep = low < -DEPTH_SHARE * size - slack
        # A body without a shape has an unknown lowest point: it may touch the ground wherever it is.
        touches = ~deep if motion.outline is None else low <= TOUCH_SHARE * size + slack
        touches &= _presses(manifest, correction)
        lies = np.abs(low) <= LYING_SHARE * size + 4 * correction.length * motion.windows.noise
    return deep, touches | _touches_others(manifest, motion, correction), lies


def _touches_others(manifest: CaptureManifest, motion: TrackedMotion, correction: Correction) -> NDArray[np.bool_]:
    """Return in which windows a body may touch other bodies or fixed surfaces."""
    own = np.inf if motion.outline is None else motion.outline.size_m
    touches = np.zeros(len(motion.windows.first), bool)
    for place, size in motion.others:
        between = correction.length * np.linalg.norm(motion.track.position_m - place, axis=1)
        nearest, _ = motion.windows.extremes(between)
        touches |= nearest <= 1.3 * correction.shape * (own + size)
    if manifest.surfaces:
        apart = surface_distance(manifest.surfaces, correction.length * motion.track.position_m)
        nearest, _ = motion.windows.extremes(apart)
        touches |= nearest <= 1.3 * correction.shape * own
    return touches


def _presses(manifest: CaptureManifest, correction: Correction) -> bool:
    """Return whether gravity presses bodies onto the ground, which then can hold them."""
    ground = manifest.world.ground
    if ground is None:
        return False
    gravity = np.array(correction.gravity or manifest.world.gravity_m_s2)
    return float(gravity @ np.array(correction.normal or ground.normal)) < 0 or not gravity.any()


def clearance(manifest: CaptureManifest, motion: TrackedMotion, correction: Correction) -> Array | None:
    """Return the height of the lowest point of a body over the ground [m], shape (T,); None without a ground."""
    ground = manifest.world.ground
    if ground is None:
        return None
    normal = np.array(correction.normal or ground.normal)
    offset = ground.offset_m if correction.offset_m is None else correction.offset_m
    height = correction.length * motion.track.position_m @ normal - offset
    return height + correction.shape * motion.lowest(normal, correction.order)


def _better_corrections(
    manifest: CaptureManifest, motions: Sequence[TrackedMotion], written: Agreement
) -> list[Correction]:
    """Return the corrections that explain the motion much better, the best first; none if it is explained."""
    if not written.contradicts(_is_suspected(manifest)):
        return []
    ranked = []
    for correction in _corrections(manifest, motions):
        result = agreement(manifest, motions, correction)
        if result.explains(written, correction):
            ranked.append((result.wrong + result.misfit, correction))
    ranked.sort(key=lambda entry: entry[0])
    return [correction for left, correction in ranked if left <= ranked[0][0] + ALIKE]


def _is_suspected(manifest: CaptureManifest) -> bool:
    """Return whether the ground is steeper than any ramp, or overhead."""
    gravity, ground = np.array(manifest.world.gravity_m_s2), manifest.world.ground
    return ground is not None and -float(gravity @ ground.normal) < STEEP_COSINE * float(np.linalg.norm(gravity))


def _corrections(manifest: CaptureManifest, motions: Sequence[TrackedMotion]) -> Iterator[Correction]:
    ground = manifest.world.ground
    yield from unit_corrections()
    gravity = np.array(manifest.world.gravity_m_s2)
    frames = frame_corrections(gravity, None if ground is None else np.array(ground.normal))
    # A ground that holds nothing explains nothing.
    yield from (one for one in frames if ground is None or _presses(manifest, one))
    gaps = [gap for motion in motions if (gap := clearance(manifest, motion, AS_WRITTEN)) is not None]
    if ground is not None and gaps:
        lowest = float(np.median([np.quantile(gap, 0.02) for gap in gaps]))
        yield ground_correction(ground.offset_m + lowest)


def _better_order(manifest: CaptureManifest, motions: Sequence[TrackedMotion]) -> Correction | None:
    """Return the order of quaternions with which bodies lie on the ground, where they reach into it as written."""
    seen = [m for m in motions if m.track.quat_wxyz is not None and m.outline is not None and m.outline.points.any()]
    if manifest.world.ground is None or not seen:
        return None

    written = float((_depths(manifest, seen, AS_WRITTEN) > LYING_SHARE).mean())
    if written < LYING_FRAMES:
        return None
    return next((one for one in ORDERS if _lies(_depths(manifest, seen, one), written)), None)


def _lies(depths: Array, written: float) -> bool:
    """Return whether bodies lie on the ground by these depths, and far fewer reach into it than as written."""
    tight, deep = (np.abs(depths) < LYING_TIGHT).mean(), (depths > LYING_SHARE).mean()
    return bool(tight >= LYING_FRAMES and deep <= written / 10)


def _depths(manifest: CaptureManifest, motions: Sequence[TrackedMotion], correction: Correction) -> Array:
    """Return depths under the ground, which there is, of all frames of motions with outlines, as shares of the size."""
    shares = []
    for motion in motions:
        gap = clearance(manifest, motion, correction)
        assert gap is not None and motion.outline is not None
        shares.append(-gap / motion.outline.size_m)
    return np.concatenate(shares)


def check_gravity(gravity_m_s2: Sequence[float], ground: Ground | None, where: str) -> None:
    """Refuse a gravity that points out of the ground, or has the strength of another unit, where no motion tells.

    Args:
        gravity_m_s2: Gravity, world frame.
        ground: The ground, or None.
        where: File, for the message.

    Raises:
        InputDataError: If it does.
    """
    gravity = np.array(gravity_m_s2)
    strength = float(np.linalg.norm(gravity))
    for name, factor in LENGTHS.items():
        if strength > 300 and abs(strength * factor / 9.81 - 1) < 0.02:
            raise InputDataError(
                f"{where}: gravity_m_s2 has {strength:.4g} m/s2, which is that of the Earth in {name}/s2.",
                *_allowed("correct gravity_m_s2."),
            )
    if ground is not None and strength and float(gravity @ ground.normal) > 0.2 * strength:
        raise InputDataError(
            f"{where}: gravity_m_s2 {_shown(gravity)} points out of the ground, whose normal is "
            f"{_shown(np.array(ground.normal))}.",
            *_allowed("correct the sign of gravity_m_s2 or of the ground's normal."),
        )


def _check_densities(capture: CaptureFolder, where: str) -> None:
    """Refuse a box or ball of another unit: its given mass in that volume is denser or thinner than any body.

    And a centre of mass outside of the shape, beyond what a rounded shape leaves.
    """
    for body in capture.manifest.bodies:
        _check_center(capture, body, where)
        solid = primitive_properties(body.shape)
        if solid is None or body.mass_kg is None:
            continue
        volume = solid.volume_m3
        density = body.mass_kg / volume
        low, high = SOLID_KG_M3
        if not low <= density <= high:
            raise InputDataError(
                f"{where}: [[bodies]] '{body.name}': {body.mass_kg:g} kg in {volume:.3g} m3 are {density:.2g} kg/m3.",
                *_allowed("correct shape or mass_kg.", f"{low:g} to {high:g} kg/m3: shapes in metres, masses in kg."),
            )


def _check_center(capture: CaptureFolder, body: Body, where: str) -> None:
    outline = None if body.com_m is None else outline_of(capture, body)
    if outline is not None and float(np.linalg.norm(body.com_m or ())) > FARTHEST_COM * outline.size_m:
        raise InputDataError(
            f"{where}: [[bodies]] '{body.name}': com_m lies {np.linalg.norm(body.com_m or ()):.3g} m from the "
            f"origin of the body frame; its shape reaches {outline.size_m:.3g} m.",
            "a centre of mass within the shape, in metres.",
            "correct com_m or shape.",
        )


def _contradiction(written: Agreement) -> str:
    parts = []
    if written.buried >= OFF:
        parts.append(f"a body is under the ground in {100 * written.buried:.0f} % of the measured motion")
    if written.flights >= FEWEST and written.adrift >= ADRIFT:
        parts.append(
            f"in {100 * written.adrift:.0f} % of the motion in which nothing touches a body it does not fall with the "
            "gravity of [world]"
        )
    return ", and ".join(parts)


def _fault(capture: CaptureFolder, what: str, found: Sequence[Correction]) -> InputDataError:
    causes = ", or ".join(correction.mistake for correction in found[:3])
    where = f"{capture.root / 'capture.toml'} and its tracks"
    return InputDataError(f"{where}: {what}. What explains it: {causes}.", *_allowed(found[0].remedy))


def _allowed(remedy: str, allowed: str = "") -> tuple[str, str]:
    return (
        allowed or "metres, seconds, quaternions w first, and one frame for tracks, gravity and ground.",
        f"{remedy} If the capture is right as it is: --accept-units.",
    )


def _warnings(manifest: CaptureManifest, motions: Sequence[TrackedMotion], where: str) -> Iterator[str]:
    """Yield what is off by more than a tenth, with its candidates."""
    gravity = np.array(manifest.world.gravity_m_s2)
    strength = float(np.linalg.norm(gravity))
    flights, under = [], []
    for motion in motions:
        deep, touches, _ = _contact(manifest, motion, AS_WRITTEN)
        free = ~touches & ~deep & (motion.windows.std_error <= MEASURED_SHARE / 4 * max(strength, 1e-12))
        flights.append(motion.windows.acceleration[free])
        under += _share_under(manifest, motion)
    measured = np.concatenate(flights)
    if strength and len(measured) >= FEWEST:
        yield from _other_fall(measured, gravity, where)
    if under and np.mean(under) > OFF:
        yield (
            f"{where}: in {100 * np.mean(under):.0f} % of the frames a body is under the ground by more than "
            f"{MEASURED_SHARE:.0%} of its size. Candidates: the ground's height or tilt, the shape, the tracked point."
        )


def _share_under(manifest: CaptureManifest, motion: TrackedMotion) -> list[float]:
    """Return the share of frames in which a body is under the ground; nothing of one without an outline."""
    gap = clearance(manifest, motion, AS_WRITTEN)
    if gap is None or motion.outline is None:
        return []
    limit = MEASURED_SHARE * motion.outline.size_m + 4 * motion.windows.noise
    return [float((gap < -limit).mean())]


def _other_fall(measured: Array, gravity: Array, where: str) -> Iterator[str]:
    """Yield a warning where the accelerations (n, 3) of free bodies are not that of gravity [m/s2]."""
    middle = np.median(measured, axis=0)
    if np.linalg.norm(middle - gravity) > OFF * float(np.linalg.norm(gravity)):
        yield (
            f"{where}: where nothing touches the bodies, their acceleration is {_shown(middle)} m/s2 (median of "
            f"{len(measured)} windows); gravity is {_shown(gravity)} m/s2. Candidates: forces in the air (drag, "
            "lift, buoyancy, wind), a carried body, a tilted frame, another frame rate, another scale of length."
        )


def _shown(values: Array) -> str:
    return "(" + ", ".join(f"{value + 0.0:.3g}" for value in values) + ")"
