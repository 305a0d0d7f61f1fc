"""The real-like cases: which effects are hidden in which engine's motion, with development and report seeds apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args
from zlib import crc32

import numpy as np
from cgwm.datasets.synthetic.hidden_effects import EFFECTS, KNOWN, UNKNOWN, Case
from cgwm.datasets.synthetic.hidden_effects.protocol import Protocol
from cgwm.datasets.synthetic.hidden_effects.things import Kind

from . import invented
from .engines import ENGINE_OF, GROUPS, can_hide

Stage = Literal[
    "development",
    "report1",
    "report2",
    "report3",
    "report4",
    "report5",
    "report6",
    "report7",
    "report8",
    "report9",
    "report10",
    "report11",
    "report12",
    "report13",
    "report14",
    "report15",
    "report16",
    "report17",
    "report18",
    "report19",
]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""Thresholds may be chosen on `development` alone. Each report stage is read once, after everything is fixed: the first
that was not yet run is the one to use, and what it says is never a reason to change the version that it judges."""
Row = Literal["null", "flight", "measurement", "contact", "pair", "unknown", "tossed"]
ROWS: tuple[Row, ...] = get_args(Row)
RATES_HZ = (60.0, 100.0, 148.0, 240.0)
TRAIN, TEST = 8, 4
TOSSES = 14
"""Training episodes of the row tossed, all throws of a body whose turns are measured: from these a default fit decides
whether it estimates the centre of mass, its moments and the scale of lengths, too, and hardly ever from mixed ones."""
NULLS, EACH = 200, 156
"""Nulls for each engine, and captures of each other row (a multiple of the six groups), of a report."""
FAMILIES: tuple[set[str], ...] = (
    {"linear_drag", "quadratic_drag", "wind"},
    {"gravity_tilt", "frame_tilt", "constant_force", "wind"},
    {"gravity_scale", "buoyancy", "length_scale", "clock_scale", "constant_force"},
    {"com_offset", "marker_offset", "inertia_shape"},
    {"friction_patch", "anisotropic_friction", "stribeck_friction", "viscous_friction"},
    {"ground_magnet", "adhesion", "velocity_restitution"},
    {"rolling_resistance", "torsional_friction", "spin_damping"},
)
"""Effects that do much the same: no pair is drawn from one of these."""
_CENTROIDS = {"linear_drag", "quadratic_drag", "wind", "constant_force", "gravity_tilt", "gravity_scale", "buoyancy"}
_CENTROIDS |= {"length_scale", "clock_scale", "gust", "shaking", "attractor", "heading_force", "gravity_step"}
_CENTROIDS |= {"side_step", "fading", "height_force", "swirl", "cubic_drag", "dry_drag", "updraft"}
_CENTROIDS |= {"jet", "low_updraft", "ramp", "drag_crisis"}
_CENTROIDS |= {"fast_drag", "slow_drag", "swinging_weight", "one_way_drag", "height_spring"}
"""Effects that show without orientations; balls with these, or none, have centroids only in 3 of 10 captures."""


@dataclass(frozen=True, kw_only=True)
class RealCase:
    """One real-like capture; everything else is drawn from its seed.

    name: stable, the seed follows from it; group: of `engines.GROUPS`; thing: the body; effects: hidden; row: of the
    table; seed: even for development, odd for reports; tosses: training episodes that are all throws, 0 for mixed ones.
    """

    name: str
    group: str
    thing: Kind
    effects: tuple[str, ...]
    row: Row
    seed: int
    tosses: int = 0

    @property
    def engine(self) -> str:
        """The engine, without its setting."""
        return ENGINE_OF[self.group]

    def rng(self, purpose: str) -> np.random.Generator:
        """Return a generator for one purpose, whose draws do not depend on those for others."""
        return np.random.default_rng([self.seed, *b"real", *purpose.encode()])

    def body_case(self) -> Case:
        """Return body, protocol, rate and length, drawn."""
        rng = self.rng("body")
        size = float(rng.uniform(0.6, 1.3))
        protocols: tuple[Protocol, ...] = ("mixed", "mixed", "mixed", "throws", "drops")
        # what acts in contact has to be seen there, and nothing much happens to a fall of half a metre
        protocol = protocols[int(rng.integers(5 if self.row == "null" else 4))]
        if any(EFFECTS[name].acts == "contact" for name in self.effects):
            protocol = "mixed"
        centroids = self.thing == "ball" and set(self.effects) <= _CENTROIDS and rng.uniform() < 0.3
        if self.tosses:
            protocol, centroids = "throws", False
        return Case(
            name=self.name,
            thing=self.thing,
            effects=self.effects,
            seed=self.seed,
            law=GROUPS[self.group][1],
            protocol=protocol,
            train=self.tosses or TRAIN,
            test=TEST,
            rate_hz=float(rng.choice(RATES_HZ)),
            centroid_only=bool(centroids),
            proportions=(size, size, size),
        )


def real_cases(stage: Stage, nulls: int = NULLS, each: int = EACH, more: int = 0, tossed: int = 0) -> list[RealCase]:
    """Return the cases of a stage: nulls for each engine (MuJoCo's over its settings), and so many of each other row.

    A case's name, and with it the whole capture, does not depend on how many there are.

    Args:
        stage: Development or a report.
        nulls: Captures without an effect for each engine.
        each: Captures of each other row.
        more: Further captures of the row unknown, with the laws of `invented`: reports before report9 had none.
        tossed: Captures of the row tossed, a third each with nothing hidden, an effect of flight and one of the
            measurement: reports before report19 had none.

    Raises:
        ValueError: If there is no such stage.
    """
    if stage not in STAGES:
        raise ValueError(f"stage '{stage}'; there are {', '.join(STAGES)}")
    engines: dict[str, list[str]] = {}
    for group in GROUPS:
        engines.setdefault(ENGINE_OF[group], []).append(group)
    found = [_case(stage, "null", groups[k % len(groups)], k) for groups in engines.values() for k in range(nulls)]
    groups = list(GROUPS)
    found += [_case(stage, row, groups[k % len(groups)], k) for row in ROWS[1:-1] for k in range(each)]
    found += [_tossed(stage, groups[k % len(groups)], k) for k in range(tossed)]
    lists = [kind for kind in _INVENTED if _laws(stage, kind)]
    return found + [_invented(stage, groups[k % len(groups)], k, kind) for kind in lists for k in range(more)]


def _case(stage: Stage, row: Row, group: str, k: int) -> RealCase:
    stem = f"real-like/{stage}/{row}/{group}/{k}"
    code = crc32(stem.encode())
    seed = 2 * (code // 2) + (stage != "development")
    rng = np.random.default_rng([seed, *b"plan"])
    effects: tuple[str, ...] = ()
    thing: Kind = ("cube", "ball")[int(rng.integers(2))]
    if row == "pair":
        effects = _pair(group, thing, rng)
    elif row == "unknown":
        effects = (str(rng.choice(UNKNOWN)),)
    elif row != "null":
        fit = [name for name in KNOWN if EFFECTS[name].acts == row and thing in EFFECTS[name].things]
        effects = (str(rng.choice([name for name in fit if can_hide(group, name)])),)
    name = "/".join((stem, thing, "+".join(effects))) if effects else f"{stem}/{thing}"
    return RealCase(name=name, group=group, thing=thing, effects=effects, row=row, seed=seed)


def _tossed(stage: Stage, group: str, k: int) -> RealCase:
    """Return a case of many throws, mostly of a box: with nothing hidden, or an effect of flight or measurement."""
    stem = f"real-like/{stage}/tossed/{group}/{k}"
    seed = 2 * (crc32(stem.encode()) // 2) + (stage != "development")
    rng = np.random.default_rng([seed, *b"plan"])
    thing: Kind = ("cube", "cube", "ball")[int(rng.integers(3))]
    acts = (None, "flight", "measurement")[int(rng.integers(3))]
    fit = [name for name in KNOWN if EFFECTS[name].acts == acts and thing in EFFECTS[name].things]
    effects = (str(rng.choice(fit)),) if fit else ()
    name = "/".join((stem, thing, *effects))
    return RealCase(name=name, group=group, thing=thing, effects=effects, row="tossed", seed=seed, tosses=TOSSES)


_INVENTED = ("invented", "bounded")
"""Lists of the laws of `invented`, of which a stage has those that it has laws of."""


def _laws(stage: Stage, kind: str) -> tuple[str, ...]:
    """Return the laws of a list that a stage hides: those of development, or those that it lacks."""
    if stage == "development":
        return invented.DEVELOPMENT if kind == "invented" else invented.BOUNDED
    if kind != "invented":
        return ()
    return invented.UNSEEN if STAGES.index(stage) < STAGES.index("report11") else invented.UNSEEN + invented.STRANGE


def _invented(stage: Stage, group: str, k: int, kind: str) -> RealCase:
    """Return a case whose law is one of a list of `invented`."""
    stem = f"real-like/{stage}/{kind}/{group}/{k}"
    seed = 2 * (crc32(stem.encode()) // 2) + (stage != "development")
    rng = np.random.default_rng([seed, *b"plan"])
    thing: Kind = ("cube", "ball")[int(rng.integers(2))]
    law = str(rng.choice(_laws(stage, kind)))
    return RealCase(name=f"{stem}/{thing}/{law}", group=group, thing=thing, effects=(law,), row="unknown", seed=seed)


def _pair(group: str, thing: Kind, rng: np.random.Generator) -> tuple[str, str]:
    """Return two effects that a group can hide and that are of no common family."""
    fit = [name for name in KNOWN if thing in EFFECTS[name].things and can_hide(group, name)]
    first = str(rng.choice(fit))
    near = {first}.union(*(family for family in FAMILIES if first in family))
    return first, str(rng.choice([name for name in fit if name not in near]))
