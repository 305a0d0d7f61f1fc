"""A case: the hidden effects of a capture, the motion, and the measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .mechanics import Hidden
from .protocol import Protocol
from .registry import EFFECTS, Size, draw_effect
from .things import Kind, Thing, draw_thing


@dataclass(frozen=True)  # name, thing and effects are given by position in lists of cases
class Case:
    """Complete description of a capture; equal cases give captures that are equal to the last bit.

    Args:
        name: Stable name, from which random draws derive.
        thing: The body: "cube" (a box of about 10 cm) or "ball" (35 mm radius).
        effects: Names from `EFFECTS`; none for a null.
        magnitude: Magnitude of all effects.
        seed: Seed of the body, the parameters of the effects, the throws and the noise.
        law: Contact law, 1 or 2 (see `mujoco_engine`); ignored by drake.
        protocol: Kinds of motion.
        train: Number of training episodes.
        test: Number of test episodes.
        length_s: Length of an episode, in true time.
        rate_hz: Rate of the measurement.
        position_std_m: Standard deviation of the noise of each coordinate.
        rotation_std_rad: Standard deviation of the noise about each body axis.
        mass_given: Whether the manifest has the mass.
        inertia_given: Whether the manifest has the inertia and the centre of mass of the homogeneous body.
        noise_given: Whether the manifest has the noise.
        centroid_only: Whether tracks have no orientation.
        outliers: Share of the samples that are grossly wrong (2 to 10 cm, and 20 to 60 degrees).
        gaps: Number of gaps of 3 to 8 samples in every episode.
        uneven: Spread of the times, in sampling intervals (0.3: each time off by up to that).
        lasting: Correlation of the errors of neighbouring frames.
        smoothed: Frames of the window in which parabolas smooth the tracks (Savitzky & Golay 1964), odd; 0 for none.
        proportions: Factors of the body's half extents.
        friction: Replaces the drawn friction.
        damping_ratio: Replaces the drawn damping ratio of the contact.
        engine: Simulator, one of `record.ENGINES`.
        filmed: Whether it is measured by two videos with masks, and has no tracks (`filmed.film_capture`).
        film_px: Width and height of the videos.
        film_focal_px: Focal length of their cameras.
    """

    name: str
    thing: Kind
    effects: tuple[str, ...] = ()
    magnitude: Size = "large"
    seed: int = 0
    law: int = 1
    protocol: Protocol = "mixed"
    train: int = 6
    test: int = 4
    length_s: float = 1.0
    rate_hz: float = 100.0
    position_std_m: float = 0.0005
    rotation_std_rad: float = 0.0052
    mass_given: bool = True
    inertia_given: bool = False
    noise_given: bool = False
    centroid_only: bool = False
    outliers: float = 0.0
    gaps: int = 0
    uneven: float = 0.0
    lasting: float = 0.0
    smoothed: int = 0
    proportions: tuple[float, float, float] = (1.0, 1.0, 1.0)
    friction: float | None = None
    damping_ratio: float | None = None
    engine: str = "mujoco"
    filmed: bool = False
    film_px: tuple[int, int] = (320, 240)
    film_focal_px: float = 420.0

    def __post_init__(self) -> None:
        unknown = [name for name in self.effects if name not in EFFECTS]
        if unknown:
            raise ValueError(f"no effect '{unknown[0]}'; there are {', '.join(EFFECTS)}")
        if self.law not in (1, 2, 3):
            raise ValueError(f"contact law {self.law}; there are 1 and 2, and 3 for trials")
        if not 0 <= self.uneven < 0.5:
            raise ValueError(f"times uneven by {self.uneven:g} intervals; at least 0, below 0.5")

    def rng(self, purpose: str) -> np.random.Generator:
        """Return a random generator for one purpose, so that its draws do not depend on those for other purposes."""
        return np.random.default_rng([self.seed, *purpose.encode()])

    def drawn_thing(self) -> Thing:
        """Return the body and its contact."""
        drawn = draw_thing(self.thing, self.law, self.rng("thing"))
        half = drawn.half_extents_m * np.array(self.proportions)
        friction = drawn.friction if self.friction is None else self.friction
        damping = drawn.damping_ratio if self.damping_ratio is None else self.damping_ratio
        return replace(drawn, half_extents_m=half, friction=friction, damping_ratio=damping)

    def drawn_effects(self) -> list[Hidden]:
        """Return the effects with their true parameter values."""
        thing = self.drawn_thing()
        return [draw_effect(name, thing, self.magnitude, self.rng(f"effect {name}")) for name in self.effects]
