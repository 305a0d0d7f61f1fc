"""The generator of captures with hidden effects, against closed forms: what it hides is what it says."""

from __future__ import annotations

import ast
import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Capture
from cgwm.datasets.capture.check import check_capture
from cgwm.datasets.capture.images import read_label
from cgwm.datasets.synthetic.hidden_effects import filmed, mechanics, protocol, record, things
from cgwm.pipeline.physics.effects.registry import effect_names
from scipy.spatial.transform import Rotation

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
try:
    hidden_effects = importlib.import_module("hidden_effects")
    drake_engine = importlib.import_module("hidden_effects.drake_engine")
finally:
    sys.path.remove(str(BENCHMARKS))
Case, EFFECTS = hidden_effects.Case, hidden_effects.EFFECTS
G = 9.81
UP = np.array([0.0, 0.0, 1.0])


def silent(thing: str = "cube", *effects: str, **change: object):
    """Return a case without noise."""
    case = Case("test", thing, effects, "large", 3, position_std_m=0.0, rotation_std_rad=0.0)
    return replace(case, **change)


def motion_of(case, kind: str = "throw", length_s: float = 1.0, **change: object):
    """Return the true motion, its start and the effects."""
    thing, hidden = case.drawn_thing(), case.drawn_effects()
    start = replace(protocol.draw_start(thing, kind, case.rng("start")), **change)
    world = mechanics.build(mechanics.Mechanics.of(thing, case.law), hidden)
    return record.ENGINES[case.engine].simulate(world, hidden, start, length_s), start, hidden


def high(case, length_s: float = 0.5, **change: object):
    """Return times, positions, rotations (T, 3, 3), start and the first effect's numbers, far above the ground."""
    where = {"position_m": np.array([0.1, 0.2, 9.0])} | change
    motion, start, hidden = motion_of(case, "throw", length_s, **where)
    assert not motion.touching.any()
    rotation = Rotation.from_quat(motion.quat_wxyz, scalar_first=True).as_matrix()
    return motion.time_s, motion.position_m, rotation, start, hidden[0].values if hidden else {}


def vector(values: dict[str, float], letter: str) -> np.ndarray:
    return np.array([values[f"{letter}_{axis}"] for axis in "xyz"])


def parabola(times: np.ndarray, start, gravity: np.ndarray = -G * UP) -> np.ndarray:
    return start.position_m + times[:, None] * start.velocity_m_s + 0.5 * times[:, None] ** 2 * gravity


def far_from_a_parabola(times: np.ndarray, position: np.ndarray) -> float:
    """Return the largest distance from the best parabola [m]."""
    basis = np.vander(times, 3)
    return float(np.abs(position - basis @ np.linalg.lstsq(basis, position)[0]).max())


def test_the_generator_knows_nothing_of_the_engine() -> None:
    own = (BENCHMARKS / "hidden_effects", Path(record.__file__).parent)
    for path in (path for folder in own for path in folder.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if name.startswith("cgwm.pipeline") or name == "torch"], path


def test_free_flight_is_a_parabola_with_a_constant_spin() -> None:
    times, position, rotation, start, _ = high(silent("ball"))
    assert np.abs(position - parabola(times, start)).max() < 1e-9
    turned = rotation[0] @ Rotation.from_rotvec(times[:, None] * start.omega_body_rad_s).as_matrix()
    assert np.abs(rotation - turned).max() < 1e-8


@pytest.mark.evidence
def test_linear_drag_decays_exponentially() -> None:
    times, position, _, start, values = high(silent("cube", "linear_drag"))
    c = values["c"]
    final = -G / c * UP
    expected = start.position_m + final * times[:, None] + (start.velocity_m_s - final) * (
        (1 - np.exp(-c * times)) / c
    )[:, None]  # fmt: skip
    assert np.abs(position - expected).max() < 1e-4


@pytest.mark.evidence
def test_quadratic_drag_of_a_ball_and_of_a_box() -> None:
    for thing, tolerance in (("ball", 0.005), ("cube", 0.35)):  # a box's drag depends on which way it flies
        times, position, _, start, values = high(silent(thing, "quadratic_drag"), 0.002)
        speed = np.linalg.norm(start.velocity_m_s)
        deceleration = 2 * (parabola(times, start) - position)[-1] / times[-1] ** 2
        expected = values["k"] * speed * start.velocity_m_s
        assert np.linalg.norm(deceleration - expected) < tolerance * np.linalg.norm(expected)


@pytest.mark.evidence
def test_wind_drives_a_body_that_falls_from_rest() -> None:
    times, position, _, _, values = high(silent("ball", "wind"), 0.05, velocity_m_s=np.zeros(3))
    wind = np.array([values["w_x"], values["w_y"]])
    expected = 0.5 * values["k"] * np.linalg.norm(wind) * wind * times[-1] ** 2
    np.testing.assert_allclose(position[-1, :2] - position[0, :2], expected, rtol=0.03)


@pytest.mark.evidence
def test_magnus_lift_is_spin_times_velocity() -> None:
    velocity, omega = np.array([2.0, 0.0, 0.0]), np.array([0.0, 0.0, 12.0])
    change = {"velocity_m_s": velocity, "omega_body_rad_s": omega, "quat_wxyz": np.array([1.0, 0, 0, 0])}
    times, position, _, start, values = high(silent("ball", "magnus_lift"), 0.05, **change)
    expected = 0.5 * values["s"] * np.cross(omega, velocity) * times[-1] ** 2
    np.testing.assert_allclose((position - parabola(times, start))[-1], expected, atol=2e-5)


@pytest.mark.evidence
@pytest.mark.parametrize(("name", "law"), [("spin_damping", "linear"), ("quadratic_spin_drag", "quadratic")])
def test_spin_decays(name: str, law: str) -> None:
    times, _, rotation, start, values = high(silent("ball", name))
    before = np.linalg.norm(start.omega_body_rad_s)
    last = Rotation.from_matrix(rotation[-2].T @ rotation[-1]).magnitude() / mechanics.STEP_S
    t = times[-1]
    expected = before * np.exp(-values["d"] * t) if law == "linear" else before / (1 + values["q"] * before * t)
    assert last == pytest.approx(expected, rel=1e-3)


@pytest.mark.evidence
def test_gravity_is_turned_scaled_or_joined_by_forces() -> None:
    times, position, _, start, values = high(silent("cube", "gravity_tilt"))
    turned = Rotation.from_rotvec([values["tilt_x"], values["tilt_y"], 0.0]).apply(-G * UP)
    assert np.abs(position - parabola(times, start, turned)).max() < 1e-8
    # by the right hand: a turn about +x takes what points down towards +y
    assert np.sign(turned[1]) == np.sign(values["tilt_x"])
    for name, gravity in (
        ("gravity_scale", lambda v: -G * (1 + v["s"]) * UP),
        ("buoyancy", lambda v: (v["b"] - G) * UP),
        ("constant_force", lambda v: vector(v, "f") - G * UP),
    ):
        times, position, _, start, values = high(silent("cube", name), 0.3)
        assert np.abs(position - parabola(times, start, gravity(values))).max() < 1e-6, name


@pytest.mark.evidence
def test_the_centre_of_mass_flies_the_parabola() -> None:
    times, position, rotation, _, values = high(silent("cube", "com_offset"))
    d = vector(values, "d")
    assert far_from_a_parabola(times, position + rotation @ d) < 1e-8
    assert far_from_a_parabola(times, position) > 1e-4


@pytest.mark.evidence
def test_the_angular_momentum_of_another_inertia_is_kept() -> None:
    case = silent("cube", "inertia_shape")
    times, _, rotation, _, values = high(case)
    xx, yy, zz, xy, xz, yz = values["inertia_kg_m2"]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    spin = Rotation.from_matrix(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]).as_rotvec() / np.diff(times)[:, None]
    middle = (rotation[:-1] + rotation[1:]) / 2

    def drift(tensor: np.ndarray) -> float:
        momentum = np.einsum("tij,tj->ti", middle, spin @ tensor)
        return float(np.abs(momentum - momentum[0]).max() / np.linalg.norm(momentum[0]))

    assert drift(inertia) < 1e-4
    assert drift(np.diag(case.drawn_thing().inertia_kg_m2)) > 0.05
    assert 2 * np.linalg.eigvalsh(inertia)[-1] < np.trace(inertia)


@pytest.mark.evidence
def test_the_magnet_fades_with_the_height() -> None:
    case = silent("ball", "ground_magnet")
    radius = case.drawn_thing().size_m
    for height in (0.001, 0.1):
        start = {"position_m": np.array([0, 0, radius + height]), "velocity_m_s": np.array([0, 0, 1.0])}
        motion, _, hidden = motion_of(case, "throw", 0.002, **start)
        values, t = hidden[0].values, motion.time_s[-1]
        acceleration = 2 * (motion.position_m[-1, 2] - motion.position_m[0, 2] - t) / t**2
        expected = -G - values["A"] * (1 + (height + t / 3) / values["l"]) ** -4
        assert acceleration == pytest.approx(expected, rel=0.005)


def sliding(case, heading: np.ndarray, length_s: float = 0.2) -> tuple[float, list]:
    """Return the deceleration [m/s2] of a box that slides flat without turning, over its middle part."""
    thing = case.drawn_thing()
    start = {
        "position_m": np.array([-0.2, 0.0, thing.half_extents_m[2]]) * (1, 1, 1),
        "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0]),
        "velocity_m_s": 1.5 * heading,
        "omega_body_rad_s": np.zeros(3),
    }
    motion, _, hidden = motion_of(case, "slide", length_s, **start)
    late = motion.time_s > 0.03
    along = motion.position_m[late] @ heading
    return -2 * float(np.polyfit(motion.time_s[late], along, 2)[0]), hidden


@pytest.mark.parametrize("law", [1, 2])
def test_a_sliding_box_slows_by_friction(law: int) -> None:
    case = silent("cube", law=law)
    deceleration, _ = sliding(case, np.array([1.0, 0, 0]))
    assert deceleration == pytest.approx(case.drawn_thing().friction * G, rel=0.01)


@pytest.mark.evidence
def test_friction_by_direction_by_place_and_by_speed() -> None:
    case = silent("cube", "anisotropic_friction")
    mu = case.drawn_thing().friction
    for heading, side in ((np.array([1.0, 0, 0]), 1), (np.array([0.0, 1, 0]), -1)):
        found, hidden = sliding(case, heading)
        assert found == pytest.approx((mu + side * hidden[0].values["a"]) * G, rel=0.02)
    case = silent("cube", "viscous_friction")
    found, hidden = sliding(case, np.array([1.0, 0, 0]), 0.06)
    expected = mu * G + hidden[0].values["c_v"] * 1.35 / case.drawn_thing().mass_kg
    assert found == pytest.approx(expected, rel=0.03)
    stribeck, plain = (motion_of(silent("cube", *effects), "slide")[0] for effects in (("stribeck_friction",), ()))
    shift = np.linalg.norm(stribeck.position_m - plain.position_m, axis=1)
    assert shift[200] < 1e-3 and shift[-1] > 5e-3  # it stops earlier, as friction grows where it is slow
    case = silent("cube", "friction_patch")
    values = case.drawn_effects()[0].values
    inside = {"position_m": np.array([values["x_m"], values["y_m"], case.drawn_thing().half_extents_m[2]])}
    inside |= {"velocity_m_s": np.array([1.5, 0, 0]), "omega_body_rad_s": np.zeros(3)}
    inside |= {"quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
    motion, _, _ = motion_of(case, "slide", 0.06, **inside)
    late = motion.time_s > 0.02
    found = -2 * np.polyfit(motion.time_s[late], motion.position_m[late, 0], 2)[0]
    assert found == pytest.approx((mu + values["change"]) * G, rel=0.03)


def spinning(case, omega: np.ndarray, velocity: np.ndarray, length_s: float):
    radius = case.drawn_thing().size_m
    start = {"position_m": np.array([0, 0, radius]), "velocity_m_s": velocity, "omega_body_rad_s": omega}
    start |= {"quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
    motion, _, hidden = motion_of(case, "roll", length_s, **start)
    turns = Rotation.from_quat(motion.quat_wxyz, scalar_first=True)
    spin = (turns[:-1].inv() * turns[1:]).as_rotvec() / mechanics.STEP_S
    return motion, spin, hidden[0].values


@pytest.mark.evidence
def test_torsion_and_rolling_resistance_of_a_ball() -> None:
    case = silent("ball", "torsional_friction")
    thing = case.drawn_thing()
    motion, spin, values = spinning(case, np.array([0, 0, 15.0]), np.zeros(3), 0.2)
    rate = np.polyfit(motion.time_s[200:-1], spin[200:, 2], 1)[0]
    assert rate == pytest.approx(-values["c_t"] * thing.mass_kg * G / thing.inertia_kg_m2[2], rel=0.02)
    case = silent("ball", "rolling_resistance")
    radius = case.drawn_thing().size_m
    motion, _, values = spinning(case, np.array([0, 1.0 / radius, 0]), np.array([1.0, 0, 0]), 0.5)
    rate = 2 * np.polyfit(motion.time_s[200:], motion.position_m[200:, 0], 2)[0]
    assert rate == pytest.approx(-values["c_r"] * G / (1.4 * radius), rel=0.03)


def bounce(case, speed: float) -> float:
    """Return the restitution of a ball that comes down at a speed [m/s]."""
    radius = case.drawn_thing().size_m
    start = {"position_m": np.array([0, 0, radius + 1e-3]), "velocity_m_s": np.array([0, 0, -speed])}
    motion, _, _ = motion_of(case, "drop", 0.03, **start, omega_body_rad_s=np.zeros(3))
    last = np.flatnonzero(motion.touching)[-1] + 2
    return float(np.diff(motion.position_m[:, 2])[last] / np.diff(motion.time_s)[last]) / speed


@pytest.mark.evidence
def test_restitution_and_how_it_falls_with_the_speed() -> None:
    from_ratio = things.restitution_of
    case = silent("ball")
    e = from_ratio(case.drawn_thing().damping_ratio)
    assert bounce(case, 2.0) == pytest.approx(e, rel=0.05)
    falling = silent("ball", "velocity_restitution")
    r = falling.drawn_effects()[0].values["r"]
    for speed in (0.5, 2.0):
        assert bounce(falling, speed) / bounce(case, speed) == pytest.approx(1 / (1 + r * speed), rel=0.06)


@pytest.mark.evidence
def test_adhesion_takes_speed_from_a_low_bounce() -> None:
    speeds = [bounce(silent("ball", *effects), 0.3) for effects in ((), ("adhesion",))]
    assert speeds[1] < 0.9 * speeds[0]


def measure(case, kind: str = "throw", length_s: float = 0.5):
    """Return the track and the true motion, far above the ground."""
    motion, _, hidden = motion_of(case, kind, length_s, position_m=np.array([0.3, -0.2, 9.0]))
    track, _ = record.measured(replace(case, length_s=length_s), hidden, motion, case.rng("noise"))
    return track, motion, hidden[0].values


@pytest.mark.evidence
def test_errors_of_the_measurement() -> None:
    track, motion, values = measure(silent("cube", "clock_scale"))
    z = np.polyfit(track.time_s, track.position_m[:, 2], 2)[0]
    assert z == pytest.approx(-0.5 * G / (1 + values["s"]) ** 2, rel=1e-6)
    plain, _, _ = measure(silent("cube", "length_scale"))
    scale = measure(silent("cube", "length_scale"))[2]["s"]
    np.testing.assert_allclose(plain.position_m[0], (1 + scale) * motion.position_m[0], rtol=1e-12)
    track, motion, values = measure(silent("cube", "frame_tilt"))
    turn = Rotation.from_rotvec([values["tilt_x"], values["tilt_y"], 0.0])
    np.testing.assert_allclose(track.position_m[0], turn.apply(motion.position_m[0]), rtol=1e-12)
    found = Rotation.from_quat(track.quat_wxyz[0], scalar_first=True)
    true = Rotation.from_quat(motion.quat_wxyz[0], scalar_first=True)
    assert (found * (turn * true).inv()).magnitude() < 1e-9
    track, _, values = measure(silent("cube", "marker_offset"))
    rotation = Rotation.from_quat(track.quat_wxyz, scalar_first=True)
    assert far_from_a_parabola(track.time_s, track.position_m - rotation.apply(vector(values, "d"))) < 1e-7
    assert far_from_a_parabola(track.time_s, track.position_m) > 1e-4


@pytest.mark.evidence
@pytest.mark.parametrize("name", hidden_effects.UNKNOWN)
def test_what_no_library_holds_bends_the_flight(name: str) -> None:
    for size, least in (("small", 0.002), ("large", 0.01)):
        motions = [motion_of(silent("ball", *effects, magnitude=size), "throw", 0.45) for effects in ((), (name,))]
        (null, *_), (bent, *_) = motions
        moved = np.linalg.norm(null.position_m - bent.position_m, axis=1).max()
        turned = Rotation.from_quat(null.quat_wxyz).inv() * Rotation.from_quat(bent.quat_wxyz)
        assert max(moved, 0.035 * turned.magnitude().max()) > least


def small(**change: object):
    return Case("secret", "ball", ("magnus_lift",), train=2, test=1, length_s=0.4, seed=7, **change)


# In the suite: nothing tells what is hidden in test_mystery.py.
@pytest.mark.evidence
def test_a_capture_is_reproducible_and_keeps_its_secret(tmp_path: Path) -> None:
    truth = hidden_effects.make_capture(tmp_path / "a", small())
    hidden_effects.make_capture(tmp_path / "b", small())
    hidden_effects.make_capture(tmp_path / "c", replace(small(), seed=8))
    texts = [sorted(path.read_text() for path in (tmp_path / name).rglob("*.*")) for name in "abc"]
    assert texts[0] == texts[1] != texts[2]
    assert not any("magnus" in text or "secret" in text for text in texts[0])
    assert truth == tmp_path / "a.truth.json"
    found = json.loads(truth.read_text())
    assert found["effects"][0]["name"] == "magnus_lift" and abs(found["effects"][0]["values"]["s"]) == 0.04
    with pytest.raises(ValueError, match="would lie in the capture"):
        hidden_effects.make_capture(tmp_path / "d", small(), tmp_path / "d" / "truth.json")
    assert not (tmp_path / "d").exists()


def test_a_capture_is_one_that_a_user_would_have(tmp_path: Path) -> None:
    hidden_effects.make_capture(tmp_path / "a", small())
    capture = Capture.open(tmp_path / "a")
    check_capture(capture)
    (body,) = capture.manifest.bodies
    assert body.mass_kg and body.inertia_kg_m2 is None and body.shape.sphere.radius_m == 0.035
    assert capture.manifest.measurement.position_std_m is None
    assert capture.manifest.splits == {"train": ("000", "001"), "test": ("002",)}
    given = {"mass_given": False, "inertia_given": True, "noise_given": True, "centroid_only": True}
    hidden_effects.make_capture(tmp_path / "b", small(**given))
    capture = Capture.open(tmp_path / "b")
    (body,) = capture.manifest.bodies
    assert body.mass_kg is None and body.com_m == (0.0, 0.0, 0.0) and body.inertia_kg_m2[0] > 0
    assert capture.manifest.measurement.position_std_m == 0.0005
    assert capture.tracks("000")["ball"].quat_wxyz is None


def test_noise_outliers_gaps_and_uneven_times() -> None:
    case = Case("noisy", "cube", ("gravity_tilt",), rate_hz=148.0, position_std_m=0.001, rotation_std_rad=0.01)
    quiet = replace(case, position_std_m=0.0, rotation_std_rad=0.0)
    motion, _, hidden = motion_of(case, "throw", 4.0, position_m=np.array([0, 0, 100.0]))
    (noisy, _), (true, _) = (
        record.measured(replace(c, length_s=4.0), hidden, motion, c.rng("noise")) for c in (case, quiet)
    )
    assert len(noisy) == 593
    assert np.std(noisy.position_m - true.position_m) == pytest.approx(0.001, rel=0.05)
    turns = [Rotation.from_quat(track.quat_wxyz, scalar_first=True) for track in (true, noisy)]
    assert np.std((turns[0].inv() * turns[1]).as_rotvec()) == pytest.approx(0.01, rel=0.05)
    rough = replace(quiet, length_s=4.0, outliers=0.05, gaps=2, uneven=0.3)
    track, wrong = record.measured(rough, hidden, motion, rough.rng("noise"))
    steps = np.diff(track.time_s) * 148
    assert steps.min() > 0.39 and np.count_nonzero(steps > 2) == 2 and len(track) < 590
    assert 15 < wrong.sum() < 50
    right = np.stack([np.interp(track.time_s, motion.time_s, motion.position_m[:, k]) for k in range(3)], 1)
    off = np.linalg.norm(track.position_m - right, axis=1)
    assert off[~wrong].max() < 1e-4 and off[wrong].min() > 0.019


@pytest.mark.evidence
def test_drake_as_a_second_truth(tmp_path: Path) -> None:
    pytest.importorskip("pydrake", reason="drake is not installed: pip install drake")
    case = silent("cube", "com_offset", engine="drake")
    motion, start, hidden = motion_of(case, "throw", 0.3, position_m=np.array([0, 0, 9.0]))
    rotation = Rotation.from_quat(motion.quat_wxyz, scalar_first=True).as_matrix()
    d = vector(hidden[0].values, "d")
    assert far_from_a_parabola(motion.time_s, motion.position_m + rotation @ d) < 1e-5
    other, _, _ = motion_of(replace(case, engine="mujoco"), "throw", 0.3, position_m=np.array([0, 0, 9.0]))
    at = np.array([0.1, 0.2, 0.29])
    (one, turned), (two, turned_too) = record.poses(motion, at), record.poses(other, at)
    assert np.abs(one - two).max() < 3e-4 and np.abs(turned - turned_too).max() < 3e-3
    plain = silent("cube", engine="drake")
    found, _ = sliding(plain, np.array([1.0, 0, 0]))
    assert found == pytest.approx(plain.drawn_thing().friction * G, rel=0.01)
    ball = silent("ball", engine="drake")
    e = float(things.restitution_of(ball.drawn_thing().damping_ratio))
    assert bounce(ball, 1.5) == pytest.approx(e, rel=0.15)
    assert bounce(ball, 3.0) < bounce(ball, 1.5) < bounce(ball, 0.5)
    drag = silent("ball", "linear_drag", engine="drake")
    times, position, _, start, values = high(drag)
    fallen = start.velocity_m_s[0] * (1 - np.exp(-values["c"] * times[-1])) / values["c"]
    assert position[-1, 0] - position[0, 0] == pytest.approx(fallen, rel=1e-3)
    with pytest.raises(ValueError, match="stribeck_friction: not with drake"):
        motion_of(silent("cube", "stribeck_friction", engine="drake"))
    truth = hidden_effects.make_capture(tmp_path / "a", small(engine="drake"))
    assert json.loads(truth.read_text())["engine"]["comes_with"] == ["velocity_restitution"]


@pytest.mark.evidence
def test_the_cases_of_drake() -> None:
    stages = [hidden_effects.drake_cases(stage) for stage in hidden_effects.STAGES]
    for found in stages:
        assert len({case.name for case in found}) == len(found)
        assert all(case.engine == "drake" and drake_engine.possible(case.drawn_effects()) for case in found)
        assert sum(not case.effects for case in found) == 40
    everything = [case.seed for stage in ("development", "report") for case in hidden_effects.cases(stage)]
    seeds = {case.seed for found in stages for case in found} | set(everything)
    assert len(seeds) == len(everything) + len(stages) * len(stages[0])


def test_the_list_of_cases() -> None:
    stages = [hidden_effects.cases(stage) for stage in hidden_effects.STAGES]
    for found in stages:
        assert len({case.name for case in found}) == len(found)
        library = {name for case in found for name in case.effects} - set(hidden_effects.UNKNOWN)
        assert library == set(effect_names()) - {
            "time_offset",
            "spin_lift",
        }  # spin_lift is of tracks without orientation
        for name in library:
            things = {case.thing for case in found if case.effects == (name,)}
            sizes = {case.magnitude for case in found if case.effects == (name,)}
            assert things == set(EFFECTS[name].things) and sizes == {"small", "large"}
        nulls = [case for case in found if not case.effects]
        assert len(nulls) == 200
        assert {(case.thing, case.law) for case in nulls} == {(t, law) for t in ("cube", "ball") for law in (1, 2)}
        assert sum(len(case.effects) == 2 for case in found) == 8 and len(hidden_effects.UNKNOWN) == 6
        assert {case.rate_hz for case in found} == {60.0, 100.0, 148.0}
        assert min(c.position_std_m for c in found) < 0.00025 and max(c.position_std_m for c in found) > 0.0018
    assert len({case.seed for found in stages for case in found}) == sum(len(found) for found in stages)
    more = hidden_effects.cases("report", repeats=2, nulls=3)
    assert {case.name for case in more} > {case.name for case in stages[1] if case.effects}
    assert set(stages[1]) & set(more) == {case for case in stages[1] if case in more}


@pytest.mark.evidence
def test_the_rough_cases(tmp_path: Path) -> None:
    found = hidden_effects.rough_cases("development", nulls=8)
    assert len(found) == 16 and sum(case.centroid_only for case in found) == 6
    assert all(case.thing == "ball" for case in found if case.centroid_only)
    assert not {case.seed for case in found} & {case.seed for case in hidden_effects.cases("development")}
    case = next(case for case in found if case.effects == ("magnus_lift",))
    hidden_effects.make_capture(tmp_path / "a", replace(case, train=1, test=1))
    capture = Capture.open(tmp_path / "a")
    check_capture(capture)
    track = capture.tracks("000")["ball"]
    assert track.quat_wxyz is None and capture.manifest.bodies[0].mass_kg is None
    assert np.diff(track.time_s).max() > 2.5 / case.rate_hz and np.ptp(np.diff(track.time_s)) > 0.5 / case.rate_hz


def test_wrong_cases_are_refused() -> None:
    with pytest.raises(ValueError, match="no effect 'lift'"):
        Case("x", "ball", ("lift",))
    with pytest.raises(ValueError, match="rolling_resistance on a cube"):
        Case("x", "cube", ("rolling_resistance",)).drawn_effects()
    with pytest.raises(ValueError, match="stage 'test'"):
        hidden_effects.cases("test")


@pytest.mark.evidence
def test_a_case_is_filmed(tmp_path: Path) -> None:
    case = replace(hidden_effects.filmed_cases("development")[0], train=1, test=1, length_s=0.1)
    truth = hidden_effects.film_capture(tmp_path / "filmed", case)
    assert json.loads(truth.read_text())["effects"][0]["name"] == "quadratic_drag"
    capture = Capture.open(tmp_path / "filmed")
    check_capture(capture)
    assert not capture.tracks("000") and not (tmp_path / "filmed" / "tracks").exists()
    hidden_effects.make_capture(tmp_path / "tracked", replace(case, position_std_m=1e-9, rotation_std_rad=1e-9))
    track = Capture.open(tmp_path / "tracked").tracks("000")["ball"]
    radius = float(case.drawn_thing().half_extents_m[0])
    for name, camera in filmed.video_cameras(case).items():
        assert sorted(capture.videos("000")) == ["left", "right"]
        for frame in (0, 4):
            mask = read_label(tmp_path / "filmed" / "video_masks" / name / "000" / f"{frame:06d}.png")
            rows, columns = np.nonzero(mask)
            x, y, z = camera.T_world_cam[:3, :3].T @ (track.position_m[frame] - camera.T_world_cam[:3, 3])
            middle = case.film_focal_px * np.array([x, y]) / z + np.array(case.film_px) / 2
            # half a pixel: the middle of pixel 0 lies at 0.5
            assert np.abs([columns.mean() + 0.5, rows.mean() + 0.5] - middle).max() < 0.15
            assert len(rows) == pytest.approx(np.pi * (case.film_focal_px * radius / z) ** 2, rel=0.06)


@pytest.mark.evidence
def test_the_filmed_cases_have_seeds_of_their_own() -> None:
    stages = [hidden_effects.filmed_cases(stage) for stage in ("development", "report")]
    assert [len(found) for found in stages] == [6, 6] and all(case.filmed for found in stages for case in found)
    assert not {case.seed for case in stages[0]} & {case.seed for case in stages[1]}
    sharp = [hidden_effects.sharp_filmed_cases(stage) for stage in ("development", "report")]
    assert [len(found) for found in sharp] == [30, 30] and all(case.filmed for found in sharp for case in found)
    assert len({case.seed for found in (*stages, *sharp) for case in found}) == 72
    for case in sharp[0]:
        # from a camera as far away as the world's origin, the smallest width is 40 pixels and more
        away_m = np.hypot(filmed.AWAY_M, filmed.HEIGHT_M)
        assert 2 * case.film_focal_px * case.drawn_thing().half_extents_m.min() / away_m >= 40


@pytest.mark.evidence
def test_the_odd_cases() -> None:
    found = hidden_effects.odd_cases("development")
    assert len({case.name for case in found}) == len(found) and len({case.seed for case in found}) == len(found)
    assert not {case.seed for case in found} & {case.seed for case in hidden_effects.cases("development")}
    plain = Case("x", "cube", seed=3)
    rod = replace(plain, proportions=(2.0, 0.3, 0.3), friction=0.9, damping_ratio=0.06)
    thing, body = plain.drawn_thing(), rod.drawn_thing()
    np.testing.assert_allclose(body.half_extents_m / thing.half_extents_m, (2.0, 0.3, 0.3))
    assert (body.friction, body.damping_ratio, body.mass_kg) == (0.9, 0.06, thing.mass_kg)


@pytest.mark.evidence
def test_errors_that_last_and_smoothed_tracks(tmp_path: Path) -> None:
    case = Case("x", "ball", train=1, test=1, seed=3)
    found = {}
    for name, changes in (
        ("exact", {"position_std_m": 1e-12, "rotation_std_rad": 1e-12}),
        ("plain", {}),
        ("lasting", {"lasting": 0.8}),
        ("smoothed", {"smoothed": 7}),
    ):
        hidden_effects.make_capture(tmp_path / name, replace(case, **changes))
        found[name] = Capture.open(tmp_path / name).tracks("000")["ball"]
    errors = {name: found[name].position_m - found["exact"].position_m for name in ("plain", "lasting")}
    shares = {name: (e[1:] * e[:-1]).sum() / (e**2).sum() for name, e in errors.items()}
    assert abs(shares["plain"]) < 0.2 and 0.6 < shares["lasting"] < 0.95
    assert errors["lasting"].std() == pytest.approx(case.position_std_m, rel=0.3)
    assert (
        np.abs(np.diff(found["smoothed"].position_m, 3, axis=0)).mean()
        < 0.5 * np.abs(np.diff(found["plain"].position_m, 3, axis=0)).mean()
    )
