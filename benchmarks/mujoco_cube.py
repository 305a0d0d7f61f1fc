"""The rival of the cube tosses: MuJoCo, a box on a plane, its contact parameters fitted by the cross-entropy method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SURFACE_M = 0.073
"""Mean distance of the cube's surface from its centre [m]: what a rotation is worth in the cost."""
STEPS_PER_FRAME = 4
"""At 148 Hz a step of 1.7 ms; MuJoCo holds contact time constants of less than two steps at two steps."""


class Number(NamedTuple):
    """A number to fit: the centre and spread of the first samples, and bounds, the values or their logarithms."""

    name: str
    center: float
    spread: float
    low: float
    high: float
    logarithmic: bool


def _positive(name: str, center: float, spread: float, low: float, high: float) -> Number:
    return Number(name, float(np.log(center)), spread, float(np.log(low)), float(np.log(high)), True)


NUMBERS = (
    _positive("sliding_friction", 0.2, 0.5, 0.02, 2.0),
    _positive("torsional_friction_m", 1e-3, 1.5, 1e-6, 0.1),
    _positive("rolling_friction_m", 1e-4, 1.5, 1e-7, 0.05),
    _positive("time_constant_s", 8e-3, 0.5, 2e-3, 0.1),
    _positive("damping_ratio", 0.5, 0.5, 0.02, 3.0),
    Number("least_impedance", 0.9, 0.1, 0.3, 0.98, False),
    _positive("impedance_width_m", 1e-3, 1.0, 1e-5, 0.05),
    # an eighth, not of the contact: the engine fits it too
    Number("ground_height_m", 0.0, 1e-3, -0.01, 0.01, False),
)
"""The seven contact parameters, and the ground's height. The largest impedance is 0.99."""

_XML = """
<mujoco>
  <option timestep="{step}" cone="elliptic" gravity="0 0 -9.81"/>
  <worldbody>
    <geom type="plane" size="10 10 1"/>
    <body>
      <freejoint/>
      <inertial pos="{com}" mass="{mass}" fullinertia="{inertia}"/>
      <geom type="box" size="{size}" condim="6"/>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True, eq=False)
class Tosses:
    """Tosses with the states at their first frames, estimated from the warm-ups.

    rate_hz; position_m, quat_wxyz: by toss, (T, 3) and (T, 4); warm: number of warm-up frames by toss; state (E, 13):
    position, quaternion, velocity of the origin (world), omega (body).
    """

    rate_hz: float
    position_m: list[Array]
    quat_wxyz: list[Array]
    warm: list[int]
    state: Array


class Rival:
    """MuJoCo's cube on a plane."""

    def __init__(
        self,
        tosses: Tosses,
        half_extents_m: Sequence[float],
        mass_kg: float,
        inertia_kg_m2: Sequence[float],
        com_m: Sequence[float],
    ) -> None:
        def text(values: Sequence[float]) -> str:
            return " ".join(f"{value:.12g}" for value in values)

        self._tosses = tosses
        self._model = mujoco.MjModel.from_xml_string(
            _XML.format(
                step=1 / (tosses.rate_hz * STEPS_PER_FRAME),
                com=text(com_m),
                mass=mass_kg,
                inertia=text((*inertia_kg_m2, 0.0, 0.0, 0.0)[:6]),
                size=text(half_extents_m),
            )
        )
        self._data = mujoco.MjData(self._model)

    def errors(self, coordinates: Array) -> tuple[Array, Array]:
        """Return translation [m] and rotation errors [deg] by toss (E,) for fitted coordinates (8,)."""
        self._set(coordinates)
        tosses = self._tosses
        found = [self._errors(e) for e in range(len(tosses.warm))]
        return np.array([t for t, _ in found]), np.array([r for _, r in found])

    def cost(self, coordinates: Array) -> float:
        """Return the mean over the tosses of about what the engine's search minimises [m]; infinite if it diverges."""
        translation, rotation = self.errors(coordinates)
        cost = float(np.hypot(translation, SURFACE_M * np.radians(rotation)).mean())
        return cost if np.isfinite(cost) else np.inf

    def _set(self, coordinates: Array) -> None:
        model = self._model
        mu, torsion, roll, time, damping, least, width = decoded(coordinates)[:7]
        # MuJoCo takes the larger friction of the two geoms and mixes their solref and solimp: both get the same
        model.geom_friction[:] = (mu, torsion, roll)
        model.geom_solref[:] = (time, damping)
        model.geom_solimp[:] = (least, 0.99, width, 0.5, 2.0)
        model.geom_pos[0, 2] = coordinates[7]

    def _errors(self, toss: int) -> tuple[float, float]:
        tosses, model = self._tosses, self._model
        position, quat, warm = tosses.position_m[toss], tosses.quat_wxyz[toss], tosses.warm[toss]
        steps = STEPS_PER_FRAME * (len(position) - 1)
        # a free joint's velocity is that of the body frame's origin (world axes) and omega in body axes, as ours
        start = np.concatenate(([0.0], tosses.state[toss]))
        states, _ = mujoco.rollout.rollout(model, self._data, start[None], nstep=steps)
        rows = np.asarray(states)[0, STEPS_PER_FRAME - 1 :: STEPS_PER_FRAME, 1:8]
        rows = np.concatenate((tosses.state[toss][None, :7], rows))[warm:]
        distance = np.linalg.norm(rows[:, :3] - position[warm:], axis=1)
        cosine = np.abs((rows[:, 3:] * quat[warm:]).sum(1)).clip(0, 1)
        return float(distance.mean()), float(np.degrees(2 * np.arccos(cosine)).mean())


def decoded(coordinates: Array) -> Array:
    """Return the values (8,) of fitted coordinates (8,)."""
    return np.where([number.logarithmic for number in NUMBERS], np.exp(coordinates), coordinates)


def cross_entropy(rival: Rival, population: int, generations: int, elites: int, seed: int) -> tuple[Array, list[float]]:
    """Fit the rival's numbers by the cross-entropy method to the mean displacement of a point on the surface.

    Every generation is drawn from a normal fitted to the best of the one before, with half of the old spread mixed in
    so that it does not collapse early.

    Returns:
        The mean of the last elites (8,), and the lowest cost [m] of every generation.
    """
    rng = np.random.default_rng(seed)
    mean, spread = np.array([n.center for n in NUMBERS]), np.array([n.spread for n in NUMBERS])
    low, high = np.array([n.low for n in NUMBERS]), np.array([n.high for n in NUMBERS])
    history: list[float] = []
    for _ in range(generations):
        samples = (mean + spread * rng.standard_normal((population, len(mean)))).clip(low, high)
        costs = np.array([rival.cost(sample) for sample in samples])
        best = samples[np.argsort(costs, kind="stable")[:elites]]
        mean, spread = best.mean(0), 0.5 * spread + 0.5 * best.std(0)
        history.append(float(costs.min()))
    return mean, history
