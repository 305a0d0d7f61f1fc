"""Mistakes in units and conventions that a capture can contain, each as the correction that would undo it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Order = Literal["wxyz", "xyzw", "inverse"]

LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
"""Units of length in metres."""
MISREAD = {"millimetres taken for centimetres": 0.1, "centimetres taken for millimetres": 10.0}
"""Units of length taken for each other, and the factor that mends it."""
TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "minutes": 60.0}
"""Units of time in seconds."""
FRAME_RATES = (24, 25, 30, 50, 60, 90, 100, 120, 200, 240, 250, 300, 400, 500)
"""Usual frame rates [Hz], for times that are the numbers of frames."""
RATE_FACTORS = (2, 3, 4, 5, 6, 8, 10, 16, 20)
"""Ratios of two frame rates that are taken for one another; others, such as 25 for 30, are within what effects do."""
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Correction:
    """What to multiply or replace in a capture to undo a mistake; the defaults change nothing."""

    mistake: str = ""
    """The mistake in words, as a statement about the file."""
    remedy: str = ""
    """What to do about it."""
    length: float = 1.0
    """Factor of the tracks' positions."""
    time: float = 1.0
    """Factor of the tracks' times."""
    shape: float = 1.0
    """Factor of the shapes."""
    gravity: tuple[float, float, float] | None = None
    """Gravity instead of that of the manifest [m/s2]."""
    normal: tuple[float, float, float] | None = None
    """Normal of the ground instead of that of the manifest."""
    offset_m: float | None = None
    """Height of the ground along its normal instead of that of the manifest [m]."""
    order: Order = "wxyz"
    """Order in which the quaternions are written, or `inverse`: world to body."""
    exact: bool = False
    """Whether forces in the air could be taken for it, so that only an acceleration within a few percent counts."""

    @property
    def changes_gravity(self) -> bool:
        """Whether accelerations are compared with another gravity."""
        return self.length != 1 or self.time != 1 or self.gravity is not None

    @property
    def changes_fall(self) -> bool:
        """Whether only bodies that fall can show that it is right."""
        return self.time != 1 or (self.gravity is not None and self.normal is None)


def unit_corrections() -> Iterator[Correction]:
    """Yield the corrections of units: of positions, shapes, times and frame rates."""
    yield from _length_corrections()
    yield from _time_corrections()


def _length_corrections() -> Iterator[Correction]:
    for name, factor in LENGTHS.items():
        yield Correction(
            mistake=f"the tracks' positions are in {name}",
            remedy=f"multiply px_m, py_m, pz_m by {factor:g}.",
            length=factor,
            exact=factor > 0.02,
        )
    for name, factor in MISREAD.items():
        yield Correction(
            mistake=f"the tracks' positions are 10 times too {'large' if factor < 1 else 'small'}, as of {name}",
            remedy=f"multiply px_m, py_m, pz_m by {factor:g}, or import again with the right --length-unit.",
            length=factor,
            exact=True,
        )
    for name in ("millimetres", "centimetres"):
        yield Correction(
            mistake=f"the shapes are in {name}", remedy=f"multiply [[bodies]] shape by {LENGTHS[name]:g}.",
            shape=LENGTHS[name],
        )  # fmt: skip


def _time_corrections() -> Iterator[Correction]:
    for name, factor in TIMES.items():
        yield Correction(mistake=f"the times are in {name}", remedy=f"multiply time_s by {factor:g}.", time=factor)
    for rate in FRAME_RATES:
        yield Correction(
            mistake=f"the times are numbers of frames, of {rate} per second",
            remedy=f"divide time_s by {rate}.",
            time=1 / rate,
        )
    for factor in RATE_FACTORS:
        yield Correction(
            mistake=f"the frame rate is {factor} times higher than the times say",
            remedy=f"divide time_s by {factor}.",
            time=1 / factor,
            exact=True,
        )
        yield Correction(
            mistake=f"the frame rate is {factor} times lower than the times say",
            remedy=f"multiply time_s by {factor}.",
            time=float(factor),
            exact=True,
        )


def frame_corrections(gravity: Array, normal: Array | None) -> Iterator[Correction]:
    """Yield the corrections of axes and signs, for a gravity [m/s2] and a normal of the ground.

    Another axis of the tracks' frame means another gravity and another normal in that frame. Gravity and normal may
    also be wrong by themselves.
    """
    strength = float(np.linalg.norm(gravity))
    if strength == 0:
        return
    yield from _axis_corrections(strength, normal)
    yield Correction(
        mistake="gravity has the opposite sign", remedy="correct [world] gravity_m_s2.", gravity=_three(-gravity)
    )
    for name in ("millimetres", "centimetres", "inches"):
        yield Correction(
            mistake=f"gravity is in {name} per second squared",
            remedy=f"multiply [world] gravity_m_s2 by {LENGTHS[name]:g}.",
            gravity=_three(LENGTHS[name] * gravity),
        )


def _axis_corrections(strength: float, normal: Array | None) -> Iterator[Correction]:
    """Yield the corrections of the axis that is up, for a strength of gravity [m/s2]."""
    for (name, axis), sign in itertools.product(AXES.items(), (1.0, -1.0)):
        up = sign * np.array(axis)
        word = f"{'+' if sign > 0 else '-'}{name}"
        down = _three(-strength * up)
        if normal is None:
            yield Correction(
                mistake=f"up is {word} in the tracks, which gravity does not point against",
                remedy="correct [world] gravity_m_s2, or turn the tracks.",
                gravity=down,
            )
            continue
        yield Correction(
            mistake=f"up is {word} in the tracks (another axis, or mirrored)",
            remedy="turn the tracks, or correct [world] gravity_m_s2 and ground.",
            gravity=down,
            normal=_three(up),
        )
        yield Correction(
            mistake=f"the ground's normal is {word}", remedy="correct [world] ground normal.", normal=_three(up)
        )


ORDERS = (
    Correction(
        mistake="the quaternions are in the order x, y, z, w",
        remedy="write w first: exchange the columns' contents.",
        order="xyzw",
    ),
    Correction(
        mistake="the quaternions turn the world into the body", remedy="write the conjugate quaternions.",
        order="inverse",
    ),
)  # fmt: skip


def ground_correction(offset_m: float) -> Correction:
    """Return the correction of the height of the ground to a height along its normal [m]."""
    return Correction(
        mistake=f"the ground is at another height, near offset_m = {offset_m:.3g}",
        remedy="correct [world] ground offset_m, or move the tracks.",
        offset_m=offset_m,
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
