"""Tracks cut into windows, and MuJoCo's prediction of each from a state of its own: what two rivals are built on.

A window is a flight up to the first touch, or a quarter of a second later on; its first state is fitted, so that no
error of a window spoils the next. Friction and damping of the contact are fitted to all. The contact is MuJoCo's, with
a spring of 1.5 ms.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.capture.capture import Capture
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .effects_formulas import GRAVITY, LIBRARY, WRENCHES, Moving, first_touch

Array = NDArray[Any]
mujoco: Any = importlib.import_module("mujoco")
_FLIGHT_STEP_S, _TOUCH_STEP_S, _SPRING_S = 2e-3, 5e-4, 1.5e-3
_WINDOW_S, _LEAST_FRAMES, _WORST, _MOST_GROWTH = 0.25, 8, 3.0, 2.0
_STRIBECK_M_S = 0.4
_TOUCHES = ("stribeck_friction", "velocity_restitution", "anisotropic_friction")
Values = dict[str, Array]


@dataclass(eq=False, kw_only=True)
class Window:
    """Frames of one piece: times_s (T,) from its first, position_m (T, 3), turn (T) or None; state: fitted, (12,).

    The state is a change of the first guess: position, velocity, rotation vector (after it), spin (body axes).
    """

    times_s: Array
    position_m: Array
    turn: Any
    flying: bool
    velocity: Array
    spin: Array
    state: Array = field(default_factory=lambda: np.zeros(12))

    @property
    def free(self) -> list[int]:
        """Places of the state that are fitted."""
        return list(range(12)) if self.turn is not None else list(range(6))


class Bench:
    """The training split of a capture as windows, with MuJoCo's world of its body."""

    def __init__(self, capture: Path) -> None:
        opened = Capture.open(capture, splits=("train",))
        body = opened.manifest.bodies[0]
        shape: Any = body.shape
        self.ball = shape.sphere is not None
        half = np.full(3, shape.sphere.radius_m) if self.ball else np.array(shape.box.half_extents_m)
        self.mass = float(body.mass_kg or 1.0)
        square = half**2
        self.inertia = self.mass * (0.4 * square if self.ball else (square.sum() - square) / 3)
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
        self.points, self.radius = (np.zeros((1, 3)), float(half[0])) if self.ball else (signs * (half - 1e-4), 1e-4)
        self.model = mujoco.MjModel.from_xml_string(_xml(self))
        self.data = mujoco.MjData(self.model)
        # a step that diverges while it is tried is rejected; MuJoCo would write a log into the current folder
        mujoco.set_mju_user_warning(lambda _: None)
        self.contact = np.array([0.3, 0.3])  # friction, damping ratio
        self.windows = [w for name in opened.episodes("train") for w in self._cut(opened.tracks(name)[body.name])]
        self.oriented = any(window.turn is not None for window in self.windows)
        self.noise = np.array([1e-3, 1e-2])

    def _cut(self, track: Any) -> list[Window]:
        times, places = np.asarray(track.time_s), np.asarray(track.position_m)
        turn = None if track.quat_wxyz is None else Rotation.from_quat(np.asarray(track.quat_wxyz), scalar_first=True)
        lowest = places[:, 2] - self.radius
        if turn is not None:
            lowest = (places[:, None] + np.einsum("tij,nj->tni", turn.as_matrix(), self.points))[..., 2].min(1)
            lowest = lowest - self.radius
        first = first_touch(lowest)
        # the first frames may still be in a hand
        skip = int(np.searchsorted(times, times[0] + 0.125)) if first - _LEAST_FRAMES > 0 else 0
        begin = skip if first - skip >= _LEAST_FRAMES else 0
        pieces = [(begin, first, True)] if first - begin >= _LEAST_FRAMES else []
        begin = max(first - 1, 0) if pieces else 0
        while len(times) - begin >= _LEAST_FRAMES:
            end = max(int(np.searchsorted(times, times[begin] + _WINDOW_S)), begin + _LEAST_FRAMES)
            pieces.append((begin, min(end, len(times)), False))
            begin = end
        return [_window(times[a:b], places[a:b], None if turn is None else turn[a:b], f) for a, b, f in pieces]

    def predict(self, window: Window, state: Array, contact: Array, values: Values) -> Array:
        """Return errors of a window (T, 3 or 6), measured minus predicted, in metres and radians."""
        model, data = self.model, self.data
        self._set(contact, values)
        turn = Rotation.identity() if window.turn is None else window.turn[0]
        turn = turn * Rotation.from_rotvec(state[6:9])
        data.qpos[:] = np.concatenate((window.position_m[0] + state[:3], turn.as_quat(scalar_first=True)))
        spin = window.spin + state[9:]
        data.qvel[:] = np.concatenate((window.velocity + state[3:6], spin))
        data.qacc_warmstart[:] = 0
        forces = {name: values[name] for name in WRENCHES if name in values}
        touches = {name: values[name] for name in _TOUCHES if name in values and name != "anisotropic_friction"}
        step_s = _FLIGHT_STEP_S if window.flying else _TOUCH_STEP_S
        clock = 1 + float(values["clock_scale"][0]) if "clock_scale" in values else 1.0
        out = np.empty((len(window.times_s), 7))
        out[0] = data.qpos
        for row, gap in enumerate(np.diff(window.times_s) / clock):
            count = max(int(np.ceil(gap / step_s)), 1)
            model.opt.timestep = gap / count
            for _ in range(count):
                if forces or touches:
                    self._push(forces, touches, contact)
                mujoco.mj_step(model, data)
            out[row + 1] = data.qpos
        return _errors(window, out, values)

    def _set(self, contact: Array, values: Values) -> None:
        model = self.model
        a = float(values["anisotropic_friction"][0]) if "anisotropic_friction" in values else 0.0
        model.pair_friction[:, 0], model.pair_friction[:, 1] = max(contact[0] - a, 0.01), max(contact[0] + a, 0.01)
        model.pair_solref[:] = (-1 / _SPRING_S**2, -2 * contact[1] / _SPRING_S)
        model.body_ipos[1] = values.get("com_offset", np.zeros(3))
        inertia = np.diag(self.inertia)
        if "inertia_shape" in values:
            a, b, c, d, e = values["inertia_shape"]
            change = np.array([[1 + a, c, d], [c, 1 + b, e], [d, e, 1 - a - b]])
            inertia = np.sqrt(inertia) @ change @ np.sqrt(inertia)
        moments, axes = np.linalg.eigh(inertia)
        model.body_inertia[1] = np.maximum(moments, 1e-9)
        turn = Rotation.from_matrix(axes * np.linalg.det(axes))
        model.body_iquat[1] = turn.as_quat(scalar_first=True)
        self.data.xfrc_applied[:] = 0

    def _push(self, forces: Values, touches: Values, contact: Array) -> None:
        """Set the force of the next step, and what its contacts are like."""
        data, model = self.data, self.model
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, data.qpos[3:])
        rotation = rotation.reshape(3, 3)
        omega, speed = rotation @ data.qvel[3:], data.qvel[:3]
        arms = self.points @ rotation.T
        heights = data.qpos[2] + arms[:, 2] - self.radius
        force, torque = np.zeros(3), np.zeros(3)
        moving = Moving(
            speed=speed, omega=omega, lowest=float(heights.min()), turning=float(self.inertia.mean()) / self.mass
        )
        for name, value in forces.items():
            one, turning = WRENCHES[name](value, moving)
            force, torque = force + self.mass * one, torque + self.mass * turning
        data.xfrc_applied[1, :3], data.xfrc_applied[1, 3:] = force, torque
        if touches:
            slips = speed + np.cross(omega, arms)
            if "stribeck_friction" in touches:
                slip = np.exp(-(np.hypot(slips[:, 0], slips[:, 1]) ** 2) / _STRIBECK_M_S**2)
                friction = np.maximum(contact[0] + touches["stribeck_friction"][0] * slip, 0.01)
                model.pair_friction[:, :2] = friction[:, None]
            if "velocity_restitution" in touches:
                free = heights > 0
                down = np.maximum(-slips[free, 2], 0.0)
                ratio = contact[1] * (1 + touches["velocity_restitution"][0] * down)
                model.pair_solref[free, 1] = -2 * ratio / _SPRING_S

    def weighted(self, window: Window, errors: Array) -> Array:
        """Return errors (T * n,) in units of the noise."""
        scale = np.repeat(self.noise, 3)[: errors.shape[1]]
        return (errors / scale).ravel()


def _errors(window: Window, poses: Array, values: Values) -> Array:
    """Return measured minus predicted poses (T, 3 or 6), seen with the effects of the measurement."""
    place, turn = poses[:, :3], Rotation.from_quat(poses[:, 3:], scalar_first=True)
    if "marker_offset" in values:
        place = place + turn.apply(values["marker_offset"])
    if "length_scale" in values:
        place = (1 + values["length_scale"][0]) * place
    if "frame_tilt" in values:
        tilt = Rotation.from_rotvec([*values["frame_tilt"], 0.0])
        place, turn = tilt.apply(place), tilt * turn
    if window.turn is None:
        return window.position_m - place
    return np.hstack((window.position_m - place, (turn.inv() * window.turn).as_rotvec()))


def _window(times: Array, places: Array, turn: Any, flying: bool) -> Window:
    since = times - times[0]
    count = len(times) if flying else 5
    lines = np.stack([np.ones(count), since[:count]], 1)
    seen = places[:count] + (0.5 * GRAVITY * since[:count, None] ** 2 * (0, 0, 1) if flying else 0.0)
    velocity = np.linalg.lstsq(lines, seen, rcond=None)[0][1]
    spin = np.zeros(3)
    if turn is not None:
        steps = (turn[:-1].inv() * turn[1:]).as_rotvec() / np.diff(times)[:, None]
        spin = np.median(steps[:6], axis=0)
    return Window(times_s=since, position_m=places, turn=turn, flying=flying, velocity=velocity, spin=spin)


def _xml(bench: Bench) -> str:
    """Return the world; its inertial frame is off the body's, or MuJoCo would ignore one that is set later."""

    def words(values: Any) -> str:
        return " ".join(repr(float(value)) for value in np.ravel(values))

    geoms = "".join(
        f'<geom name="p{k}" type="sphere" size="{bench.radius!r}" pos="{words(p)}" contype="0" conaffinity="0"/>'
        for k, p in enumerate(bench.points)
    )
    pairs = "".join(
        f'<pair geom1="p{k}" geom2="ground" condim="3" friction="0.3 0.3 0.005 1e-4 1e-4" solreffriction="0.01 1"'
        ' solimp="0.95 0.99 0.001"/>'
        for k in range(len(bench.points))
    )
    return f"""<mujoco><option gravity="0 0 {-GRAVITY}" cone="elliptic" impratio="10"/>
      <worldbody><geom name="ground" type="plane" size="9 9 1" contype="0" conaffinity="0"/>
        <body name="body"><freejoint/>{geoms}
          <inertial pos="1e-5 0 0" quat="1 1e-3 0 0" mass="{bench.mass!r}" diaginertia="{words(bench.inertia)}"/></body>
      </worldbody>
      <contact>{pairs}</contact></mujoco>"""


@dataclass(frozen=True, eq=False)
class Linear:
    """Errors and columns of a fitted bench, without what the windows' states and the contact can do, in noises.

    errors (n,); columns: for each effect (n, k); rows: slices of the windows; states: an orthonormal basis (m, k) of
    each window's states; counted: how many numbers are free without an effect.
    """

    errors: Array
    columns: dict[str, Array]
    kept: list[Window]
    states: list[Array]
    contact: Array
    counted: int


def fitted(bench: Bench, rounds: int = 5) -> Linear:
    """Fit states, contact and noise of a bench by Gauss-Newton steps, and return it with a column each parameter."""
    for _ in range(rounds):
        _descend(bench)
        _estimate_noise(bench)
    # a window whose impact went another way than MuJoCo's says nothing about slight effects
    told = [window for window in bench.windows if _size(bench, window, bench.contact) < _WORST]
    kept = [window for window in told if window.flying or _growth(bench, window) < _MOST_GROWTH] or bench.windows
    bases, errors, tangent = [], [], []
    columns: dict[str, list[Array]] = {name: [] for name in LIBRARY}
    for window in kept:
        base, local, contact = _jacobian(bench, window)
        basis, _ = np.linalg.qr(local)
        bases.append(basis)
        errors.append(_without(base, basis))
        tangent.append(_without(contact, basis))
        for name, steps in LIBRARY.items():
            own = [_change(bench, window, base, name, k, step) for k, step in enumerate(steps)]
            columns[name].append(_without(np.stack(own, 1), basis))
    contact, _ = np.linalg.qr(np.vstack(tangent))
    cleaned = {name: _without(np.vstack(own), contact) for name, own in columns.items()}
    counted = sum(basis.shape[1] for basis in bases) + contact.shape[1]
    return Linear(_without(np.concatenate(errors), contact), cleaned, kept, bases, contact, counted)


def _change(bench: Bench, window: Window, base: Array, name: str, k: int, step: float) -> Array:
    value = np.zeros(len(LIBRARY[name]))
    value[k] = step
    return -(bench.weighted(window, bench.predict(window, window.state, bench.contact, {name: value})) - base) / step


def _without(values: Array, basis: Array) -> Array:
    return values - basis @ (basis.T @ values)


def _size(bench: Bench, window: Window, contact: Array) -> float:
    errors = bench.weighted(window, bench.predict(window, window.state, contact, {}))
    return float(np.sqrt((errors**2).mean()))


def _growth(bench: Bench, window: Window) -> float:
    """Return how far a change of the first speed moves a body, over how far it would in flight: large where chaotic."""
    base, largest = bench.predict(window, window.state, bench.contact, {})[:, :3], 0.0
    for k in range(3, 6):
        moved = window.state.copy()
        moved[k] += 1e-3
        change = base - bench.predict(window, moved, bench.contact, {})[:, :3]
        largest = max(largest, float(np.abs(change).max()) / (1e-3 * float(window.times_s[-1])))
    return largest


def _estimate_noise(bench: Bench) -> None:
    """Set one noise for positions and one for angles: the median window's, of flights where there are three."""
    flights = [window for window in bench.windows if window.flying]
    chosen = flights if len(flights) > 2 else bench.windows
    sizes = [bench.predict(window, window.state, bench.contact, {}) for window in chosen]
    bench.noise[0] = max(float(np.median([np.sqrt((one[:, :3] ** 2).mean()) for one in sizes])), 1e-5)
    turns = [np.sqrt((one[:, 3:] ** 2).mean()) for one in sizes if one.shape[1] > 3]
    if turns:
        bench.noise[1] = max(float(np.median(turns)), 1e-4)


def _jacobian(bench: Bench, window: Window) -> tuple[Array, Array, Array]:
    """Return errors (m,), and what states (m, k) and the contact (m, 2) change in the prediction."""
    base = bench.weighted(window, bench.predict(window, window.state, bench.contact, {}))
    steps = np.repeat([1e-4, 1e-3, 1e-3, 1e-2], 3)
    local = []
    for k in window.free:
        moved = window.state.copy()
        moved[k] += steps[k]
        local.append((base - bench.weighted(window, bench.predict(window, moved, bench.contact, {}))) / steps[k])
    contact = []
    for k in range(0 if window.flying else 2):
        moved = bench.contact.copy()
        moved[k] += 0.01
        contact.append((base - bench.weighted(window, bench.predict(window, window.state, moved, {}))) / 0.01)
    columns = np.stack(contact, 1) if contact else np.zeros((len(base), 2))
    return base, np.stack(local, 1), columns


def _descend(bench: Bench) -> None:
    """Take one step of Gauss and Newton for states and contact, each halved until it helps."""
    parts = [_jacobian(bench, window) for window in bench.windows]
    left, right = 1e-9 * np.eye(2), np.zeros(2)
    for base, local, contact in parts:
        basis, _ = np.linalg.qr(local)
        weight = 1 / max(float(np.sqrt((base**2).mean())), 1.0) ** 2  # a window that fits badly says little
        own = _without(contact, basis)
        left, right = left + weight * own.T @ own, right + weight * own.T @ base
    step = np.clip(np.linalg.lstsq(left, right, rcond=1e-6)[0], -0.1, 0.1)
    bench.contact = np.clip(bench.contact + step, [0.02, 0.01], [1.5, 0.95])
    for window, (base, local, contact) in zip(bench.windows, parts, strict=True):
        change = np.linalg.lstsq(local, base - contact @ step, rcond=1e-9)[0]
        before, start = float(base @ base), window.state.copy()
        for share in (1.0, 0.3, 0.1):
            window.state = start.copy()
            window.state[window.free] += share * change
            errors = bench.weighted(window, bench.predict(window, window.state, bench.contact, {}))
            if float(errors @ errors) <= before or share == 0.1:
                break
