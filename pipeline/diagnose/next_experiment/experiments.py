"""Candidate experiments: a grid of initial states, each with a description in words."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ....schemas import InputDataError, ThrowGrid, ThrowsFile, read_toml
from ...physics.impulse_solver import tangent_axes
from ...physics.state import State
from ...physics.world import World

MOST_THROWS = 400
"""Maximum number of throws; more would take minutes to compare."""
FLAT_DEG, FAST_M_S, SLOW_M_S = 15.0, 3.0, 1.2
"""Limits of the descriptions: maximum elevation of "flat" [deg], minimum speed of "fast" and maximum speed of "slowly"
[m/s]."""
ALL_AXES = ("up", "along", "across")
"""Spin axes of a throw: vertical, along its path, and horizontal across its path."""
DEFAULT: tuple[ThrowGrid, ...] = (
    ThrowGrid(height_m=(0.3, 1.0), speed_m_s=(0.0,), spin_rad_s=(0.0, 15.0)),
    ThrowGrid(speed_m_s=(1.0, 2.0, 4.0), elevation_deg=(0.0, 45.0)),
    ThrowGrid(speed_m_s=(1.5, 4.0), elevation_deg=(0.0, 45.0), spin_rad_s=(15.0,), spin_axis=ALL_AXES),
    ThrowGrid(on_ground=True, speed_m_s=(0.5, 1.5, 3.0), heading_deg=(0.0, 90.0)),
    ThrowGrid(on_ground=True, speed_m_s=(0.0, 1.5), spin_rad_s=(15.0,), spin_axis=("up",)),
)
"""Default experiments, which can be made by hand: 30 drops, throws without and with spin, and slides."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Initial state of one throw, drop, slide or spin; the fields are those of `ThrowGrid`."""

    on_ground: bool
    """Whether the body starts on the ground."""
    height_m: float
    """Height of the body's lowest point above the ground [m]."""
    speed_m_s: float
    """Initial speed [m/s]."""
    elevation_deg: float
    """Angle of the velocity above the horizontal [deg]."""
    heading_deg: float
    """Horizontal direction of the velocity [deg]."""
    spin_rad_s: float
    """Initial angular speed [rad/s]."""
    spin_axis: Literal["up", "along", "across"]
    """Axis of the spin: vertical, along the path, or horizontal across it."""
    duration_s: float
    """Duration of the recording [s]."""

    @property
    def what(self) -> str:
        """Description of the experiment in words."""
        start = f"{self.height_m:.3g} m high"
        speed = f"{self.speed_m_s:.1f} m/s"
        heading = f", heading {self.heading_deg:.0f} deg" if self.heading_deg else ""
        if self.speed_m_s == 0:
            manner = "set it spinning on the ground" if self.on_ground else f"drop it {self._spin}"
            return f"{manner}: {self._rate}" if self.on_ground else f"{manner}: {start}{self._more}"
        pace = "fast" if self.speed_m_s >= FAST_M_S else "slowly" if self.speed_m_s <= SLOW_M_S else "at middling speed"
        if self.on_ground:
            return f"let it slide over the ground, {pace}, {self._spin}: {speed}{heading}{self._more}"
        if abs(self.elevation_deg) < FLAT_DEG:
            direction = "flat"
        else:
            direction = f"{'up' if self.elevation_deg > 0 else 'down'} at {abs(self.elevation_deg):.0f} deg"
        return f"throw it {direction} and {pace} {self._spin}: {speed}, {start}{heading}{self._more}"

    @property
    def _spin(self) -> str:
        """Axis of the spin in words."""
        if self.spin_rad_s == 0:
            return "without spin"
        words = {
            "up": "about the vertical",
            "along": "about its path",
            "across": "about the horizontal across its path",
        }
        return f"with spin {words[self.spin_axis]}"

    @property
    def _rate(self) -> str:
        """Angular speed with its unit."""
        return f"{self.spin_rad_s:.0f} rad/s"

    @property
    def _more(self) -> str:
        """Angular speed as the last part of a description; empty without spin."""
        return f", {self._rate}" if self.spin_rad_s else ""


def read_experiments(path: Path | str) -> list[Experiment]:
    """Read the experiments of a TOML file of `[[throws]]` tables.

    Raises:
        InputDataError: If the file is missing or invalid, or has too many throws.
    """
    found = experiments_of(read_toml(Path(path), ThrowsFile).throws)
    if len(found) > MOST_THROWS:
        raise InputDataError(f"{path}: {len(found)} throws.", f"at most {MOST_THROWS}.", "give fewer values.")
    return found


def experiments_of(grids: Sequence[ThrowGrid]) -> list[Experiment]:
    """Return the experiments of grids, each once."""
    found: dict[Experiment, None] = {}
    for grid in grids:
        axes = (
            grid.height_m[:1] if grid.on_ground else grid.height_m,
            grid.speed_m_s,
            grid.elevation_deg[:1] if grid.on_ground else grid.elevation_deg,
            grid.heading_deg,
            grid.spin_rad_s,
            grid.spin_axis,
        )
        for height, speed, elevation, heading, spin, axis in itertools.product(*axes):
            if grid.on_ground and speed == spin == 0:
                continue  # the body would only rest
            thrown = 0.0 if grid.on_ground or speed == 0 else elevation
            turned = heading if speed or (spin and axis != "up") else 0.0
            one = Experiment(
                on_ground=grid.on_ground,
                height_m=0.0 if grid.on_ground else height,
                speed_m_s=speed,
                elevation_deg=thrown,
                heading_deg=turned,
                spin_rad_s=spin,
                spin_axis=axis if spin else "across",
                duration_s=grid.duration_s,
            )
            found[one] = None
    return list(found)


def states_of(world: World, body: int, throws: Sequence[Experiment], place_m: Tensor, like: State) -> State:
    """Return the initial states (B) of experiments.

    Args:
        world: The world; without a ground, heights are measured from the place.
        body: Index of the thrown body, which starts with the identity rotation.
        throws: The experiments (B).
        place_m: Point on the ground [m], shape (3,), world frame.
        like: State (1, nb) of the other bodies.
    """
    up = world.up[0]
    x, y = tangent_axes(up[None])[0, 1:]
    rows = []
    for throw in throws:
        heading, elevation = math.radians(throw.heading_deg), math.radians(throw.elevation_deg)
        along = math.cos(heading) * x + math.sin(heading) * y
        across = math.cos(heading) * y - math.sin(heading) * x
        axis = {"up": up, "along": along, "across": across}[throw.spin_axis]
        velocity = throw.speed_m_s * (math.cos(elevation) * along + math.sin(elevation) * up)
        rows.append(torch.stack((_start(world, body, throw.height_m, place_m), velocity, throw.spin_rad_s * axis)))
    position, velocity, omega = torch.stack(rows).unbind(1)
    fields = [getattr(like, key)[:1].repeat(len(throws), 1, 1) for key in State.__dataclass_fields__]
    unturned = torch.tensor([1.0, 0, 0, 0]).to(position).expand(len(throws), 4)
    for field, values in zip(fields, (position, unturned, velocity, omega), strict=True):
        field[:, body] = values
    return State(*fields)


def described(state: State, item: int, body: int) -> dict[str, Any]:
    """Return the state of a body as in the report, rounded to 6 decimals."""
    values = {key: getattr(state, key)[item, body].tolist() for key in State.__dataclass_fields__}
    return {key: [round(value, 6) + 0.0 for value in row] for key, row in values.items()}


def _start(world: World, body: int, height_m: float, place_m: Tensor) -> Tensor:
    """Return the position (3,) [m] of an unrotated body whose lowest point has a given height above the ground."""
    normal, offset = world.ground_normal, world.ground_offset
    if normal is None or offset is None:
        return place_m + height_m * world.up[0]
    own = world.bodies[body]
    lowest = (own.centers[0] @ normal - own.radii[0]).min()
    return place_m + (offset[0] + height_m - lowest - place_m @ normal) * normal
