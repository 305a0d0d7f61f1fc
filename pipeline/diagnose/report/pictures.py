"""What the page of a diagnosis draws: residual wrenches along a coordinate, and motions with and without an effect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....schemas import DiagnoseResult, NextExperiment, NotConvergedError
from ...physics.engine import rollout
from ...physics.impulse_solver import tangent_axes
from ...physics.state import State
from ...physics.world import World
from ...segments.candidates import without_effects
from ...segments.flights.residual_wrench import ResidualWrenches, covariates_of, motion_axes
from ...segments.prepare import Prepared, whole_flights
from ...segments.segments import Segments
from ..next_experiment.experiments import Experiment
from ..next_experiment.fisher_information import experiment_states
from ..verdict import Findings

Array = NDArray[np.float64]

SHOWN_S = 1.0
"""Length of a drawn motion that was not measured [s]."""
FRAMES = 81
"""Number of points of a drawn motion."""
SLIDE = Experiment(
    on_ground=True,
    height_m=0.0,
    speed_m_s=1.0,
    elevation_deg=0.0,
    heading_deg=0.0,
    spin_rad_s=0.0,
    spin_axis="across",
    duration_s=SHOWN_S,
)
"""The motion that shows an effect in contact."""
ALONG_AXES = frozenset({"x", "y", "height", "episode"})
"""Coordinates against which forces are drawn along world axes; against the others along and across the velocity."""


@dataclass(frozen=True, eq=False)
class ForceCurve:
    """One component of the missing force or torque in windows of flight."""

    name: str
    """What it is, in words."""
    values: Array
    """Acceleration [m/s2] or angular acceleration [rad/s2], shape (n,)."""
    std: Array
    """Standard errors, same shape."""


@dataclass(frozen=True, eq=False)
class MissingForce:
    """The residual wrench against the coordinate that explains most of it."""

    coordinate: str
    """Name of the coordinate, one of `segments.residual_wrench.COORDINATES`."""
    same_everywhere: bool
    """Whether no coordinate explains more of it than one wrench everywhere."""
    share: float
    """Share of the excess over the noise that the coordinate explains, 0 to 1."""
    x: Array
    """The coordinate in each window, shape (n,)."""
    force: tuple[ForceCurve, ...]
    """Three components of the force over mass."""
    torque: tuple[ForceCurve, ...]
    """Three components of the torque over inertia; empty where no orientation was measured."""


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion seen from the side."""

    name: str
    """What it is of."""
    path: Array
    """Distance along the start's heading, and height [m], shape (T, 2)."""


@dataclass(frozen=True, eq=False)
class EffectPicture:
    """The same start with an effect and without it."""

    effect: str
    """Name of the effect."""
    start: str
    """Where the motion starts, in words."""
    time_s: Array
    """Times [s], shape (T,)."""
    motions: tuple[DrawnMotion, DrawnMotion]
    """With the effect, and without it."""
    apart_m: Array
    """Distance between the two [m], shape (T,)."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The drawings of one diagnosis."""

    missing: MissingForce | None
    """The residual wrench of the model; None without flight."""
    left: MissingForce | None
    """That with the named effects, against the same coordinate; None where none is named."""
    effects: tuple[EffectPicture, ...]
    """What each named effect does to a motion; effects of the measurement move nothing and are not in it."""
    throw: tuple[DrawnMotion, ...]
    """The next experiment; empty where none is proposed."""
    paths: tuple[DrawnMotion, ...] = ()
    """The motions to record next for contact from above: paths along the ground's x and y [m] instead of heights."""


def pictures_of(prepared: Prepared, findings: Findings, result: DiagnoseResult) -> Pictures:
    """Return what the page draws of a diagnosis."""
    before = _windows(prepared, findings.base)
    missing = None if before is None else _missing(before, prepared.has_orientation)
    after = _windows(prepared, findings.world) if result.selected and missing is not None else None
    left = None
    if after is not None and missing is not None:
        left = _missing(after, prepared.has_orientation, missing.coordinate)
    named = [one.evidence.name for one in findings.chosen] if result.selected else []
    drawn = [effect_picture(prepared, findings.world, name) for name in named]
    pictures = tuple(one for one in drawn if one is not None)
    throw = throw_of(findings.world, result.next_experiment)
    return Pictures(missing, left, pictures, throw, _paths(findings.world, result))


def _windows(prepared: Prepared, world: World) -> ResidualWrenches | None:
    return world.once(prepared.short_windows) if len(world.free) == 1 else None


def _missing(found: ResidualWrenches, turned: bool, coordinate: str | None = None) -> MissingForce:
    """Return the wrench against a coordinate; None: the one that explains most of it."""
    ordered = covariates_of(found)
    same = ordered[0].coordinate == "constant"
    chosen = next((c for c in ordered if c.coordinate == coordinate), None)
    best = chosen or ordered[0]
    name = "speed" if best.coordinate == "constant" else best.coordinate
    frames, names = _frames(found, name)
    x = found.coordinates[name].astype(np.float64)
    x = np.degrees(x) if name == "heading" else x
    curves = [_curves(found, 3 * k, frames, names) for k in range(2 if turned else 1)]
    return MissingForce(
        coordinate=name,
        same_everywhere=same,
        share=best.share,
        x=x,
        force=curves[0],
        torque=curves[1] if turned else (),
    )


def _frames(found: ResidualWrenches, coordinate: str) -> tuple[Array, tuple[str, str, str]]:
    """Return the axes (n, 3, 3) along which the wrench of each window is drawn, and their names."""
    count = len(found.velocity)
    if coordinate in ALONG_AXES:
        return np.tile(np.eye(3), (count, 1, 1)), ("along x", "along y", "along z")
    return motion_axes(found.velocity), ("along the velocity", "sideways", "across, upwards")


def _curves(found: ResidualWrenches, first: int, axes: Array, names: Sequence[str]) -> tuple[ForceCurve, ...]:
    rows = slice(first, first + 3)
    values = np.einsum("nij,nj->ni", axes, found.wrench[:, rows])
    spread = np.einsum("nij,njk,nik->ni", axes, found.covariance[:, rows, rows], axes)
    return tuple(ForceCurve(name, values[:, k], np.sqrt(spread[:, k])) for k, name in enumerate(names))


def effect_picture(prepared: Prepared, world: World, name: str) -> EffectPicture | None:
    """Return a motion with and without an effect; None for one of the measurement, and where it cannot be simulated."""
    active = next((one for one in world.effects if one.effect.name == name), None)
    if active is None or active.effect.phase == "measurement":
        return None
    if active.effect.phase == "contact" and world.ground_normal is not None:
        start, length_s = experiment_states(prepared, world, [SLIDE]), SHOWN_S
        words = "a body set on the ground at 1 m/s without spin"
    elif prepared.flight is not None:
        start, length_s = _fastest(prepared, prepared.flight)
        words = "the fastest measured flight, and last as long"
    else:
        return None
    found, bare = (_path(one, start, length_s) for one in (world, without_effects(world, name)))
    if found is None or bare is None:
        return None
    sides = [_from_side(world, start, place) for place in (found, bare)]
    motions = DrawnMotion(f"with {name}", sides[0]), DrawnMotion("without it", sides[1])
    times = torch.linspace(0.0, length_s, FRAMES).double()
    return EffectPicture(name, words, times.numpy(), motions, (found - bare).norm(dim=1).numpy())


def _fastest(prepared: Prepared, flight: Segments) -> tuple[State, float]:
    """Return the fitted start (1, nb) of the whole flight with the largest speed, and how long it was measured [s]."""
    state = flight.observations.state
    speed = state.velocity_m_s[:, flight.world.free[0]].norm(dim=1)
    whole = {(one.episode, one.first): one for one in whole_flights(flight.items)}
    first = [k for k, one in enumerate(flight.items) if (one.episode, one.first) in whole]
    item = max(first, key=lambda k: float(speed[k]))
    begin = flight.items[item]
    times = prepared.observations.times_s[begin.episode]
    length_s = float(times[whole[begin.episode, begin.first].last] - times[begin.first])
    return State(**{key: getattr(state, key)[item : item + 1] for key in State.__dataclass_fields__}), length_s


def _from_side(world: World, start: State, place: Tensor) -> Array:
    """Return distance along the start's heading and height (T, 2) [m] of a path (T, 3)."""
    body, up = world.free[0], world.up[0].double()
    velocity = start.velocity_m_s[0, body].double()
    level = velocity - (velocity @ up) * up
    x = torch.tensor([1.0, 0.0, 0.0]).to(up)
    along = level / level.norm() if float(level.norm()) > 1e-6 else x - (x @ up) * up
    return torch.stack(((place - place[0]) @ along, place @ up), 1).numpy()


def throw_of(world: World, found: NextExperiment | None) -> tuple[DrawnMotion, ...]:
    """Return an experiment as it would fly in a world; empty where none is proposed."""
    if found is None or not found.initial_state or len(world.free) != 1:
        return ()
    start = _start(world, found.initial_state)
    place = _path(world, start, SHOWN_S)
    return () if place is None else (DrawnMotion(found.what.partition(";")[0], _from_side(world, start, place)),)


def _paths(world: World, result: DiagnoseResult) -> tuple[DrawnMotion, ...]:
    """Return the motions to record next that move along the ground, each once, from above."""
    if result.next_motions is None or world.ground_normal is None:
        return ()
    level, found = tangent_axes(world.ground_normal)[1:].double(), {}
    for motion in result.next_motions.motions:
        place = _path(world, _start(world, motion.initial_state), motion.duration_s)
        if place is not None and motion.what not in found and np.linalg.norm(motion.initial_state["velocity_m_s"]) > 0:
            found[motion.what] = DrawnMotion(motion.what, (place @ level.T).numpy())
    return tuple(found.values())


def _start(world: World, state: Mapping[str, Sequence[float]]) -> State:
    """Return the state (1, nb) of the free body as a report has it; other bodies stay at the origin."""
    body, like = world.free[0], world.gravity
    rows = {key: torch.zeros(1, len(world.bodies), 4 if key == "quat_wxyz" else 3).to(like) for key in
            State.__dataclass_fields__}  # fmt: skip
    rows["quat_wxyz"][..., 0] = 1.0
    for key, row in rows.items():
        row[0, body] = torch.tensor(state[key]).to(row)
    return State(**rows)


def _path(world: World, start: State, length_s: float) -> Tensor | None:
    """Return the places (T, 3) [m] of the free body; None where it cannot be simulated."""
    times = torch.linspace(0.0, length_s, FRAMES).to(world.gravity)
    try:
        place = rollout(world, start, times).position_m[0, :, world.free[0]].double()
    except NotConvergedError:
        return None
    return place if bool(place.isfinite().all()) else None  # the kernel returns a rollout that diverged


def binned_means(x: Array, values: Array, std: Array, bins: int = 4) -> list[tuple[float, float]]:
    """Return weighted means of equally filled bins along x; empty for fewer than three points a bin."""
    if len(x) < 3 * bins:
        return []
    order = np.argsort(x, kind="stable")
    floor = float(np.median(std)) * 0.1
    weight = 1 / (std**2 + floor**2 + 1e-30)
    means = []
    for rows in np.array_split(order, bins):
        total = float(weight[rows].sum())
        if total > 0 and math.isfinite(total):
            means.append((float(weight[rows] @ x[rows]) / total, float(weight[rows] @ values[rows]) / total))
    return means
