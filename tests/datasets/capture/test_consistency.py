"""Captures that contradict themselves are refused where one mistake explains them, and all others are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.schemas import Body, BoxShape, CaptureManifest, Ground, InputDataError, Shape, SphereShape, World
from scipy.spatial.transform import Rotation

EARTH = np.array([0.0, 0.0, -9.81])
Tracks = dict[str, Track]
Force = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ball(radius_m: float = 0.03, mass_kg: float | None = None) -> Body:
    return Body(name="thing", mass_kg=mass_kg, shape=Shape(sphere=SphereShape(radius_m=radius_m)))


def cube(half_m: float = 0.05) -> Body:
    return Body(name="thing", mass_kg=0.4, shape=Shape(box=BoxShape(half_extents_m=(half_m,) * 3)))


def flight(force: Force, place: list[float], speed: list[float], seconds: float = 1.0, **plane) -> tuple:
    """Return times and places of a point that `force(velocity, place)` accelerates [m/s2] and a plane reflects."""
    normal, gap, bounce = np.array(plane.get("normal", (0, 0, 1.0))), plane.get("gap", 0.03), plane.get("bounce", True)
    position, velocity, places, steps = np.array(place), np.array(speed), [], 3
    time_s = np.arange(0, seconds, 1 / 120)
    for _ in time_s:
        places.append(position)
        for _ in range(steps):
            velocity = velocity + force(velocity, position) / 120 / steps
            position = position + velocity / 120 / steps
            inside, into = gap - position @ normal, velocity @ normal
            if bounce and inside > 0:
                push = max(0.0, -1.6 * into if into < -0.1 else -into)
                along = velocity - into * normal
                slide = min(0.2 * push, float(np.linalg.norm(along)))
                velocity = velocity + push * normal - slide * along / max(float(np.linalg.norm(along)), 1e-9)
                position = position + inside * normal
    return time_s, np.array(places)


def tosses(force: Force, seconds: float = 1.0, **plane) -> list[Track]:
    rng, tracks = np.random.default_rng(0), []
    for _ in range(4):
        start = [*rng.normal(0, 0.2, 2), rng.uniform(0.4, 1.0)]
        time_s, places = flight(force, start, [*rng.normal(0, 1, 2), rng.uniform(0, 2)], seconds, **plane)
        tracks.append(Track(time_s, places + rng.normal(0, 5e-4, places.shape)))
    return tracks


@cache
def cube_tosses() -> list[Track]:
    """Return drops of a tumbling cube that then lies on one of its faces, turned about the vertical."""
    rng, tracks = np.random.default_rng(1), []
    for k in range(4):
        time_s, places = flight(lambda v, p: EARTH, [0.1 * k, 0, 0.8], [0.5, 0.2 * k, 0.5], 0.6, bounce=False)
        flying = places[:, 2] > 0.09
        places[~flying] = [*places[flying][-1, :2], 0.05]
        turn = Rotation.from_rotvec(np.outer(time_s, [3.0, 2.0 + k, 1.0]))
        lying = Rotation.from_euler("z", 0.5 + 0.7 * k) * Rotation.from_euler("x", np.pi / 2)
        quat = turn.as_quat(scalar_first=True)
        quat[~flying] = lying.as_quat(scalar_first=True)
        tracks.append(Track(time_s, places + rng.normal(0, 3e-4, places.shape), quat))
    return tracks


def write(root: Path, body: Body, world: World, tracks: list[Track]) -> Path:
    (root / "tracks").mkdir(parents=True)
    names = [f"e{k}" for k in range(len(tracks))]
    splits = {"train": tuple(names)}
    write_manifest(
        root / "capture.toml", CaptureManifest(format="cgwm-capture/1", bodies=(body,), world=world, splits=splits)
    )
    for name, track in zip(names, tracks, strict=True):
        write_tracks(root / "tracks" / f"{name}.csv", {"thing": track})
    return root


def changed(track: Track, length: float = 1.0, time: float = 1.0, turn: np.ndarray | None = None) -> Track:
    if turn is None:
        return replace(track, time_s=time * track.time_s, position_m=length * track.position_m)
    quat = track.quat_wxyz
    if quat is not None:
        quat = (Rotation.from_matrix(turn) * Rotation.from_quat(quat, scalar_first=True)).as_quat(scalar_first=True)
    return replace(track, position_m=track.position_m @ turn.T, quat_wxyz=quat)


@cache
def ball_tosses() -> list[Track]:
    return tosses(lambda v, p: EARTH)


LEVEL = World(ground=Ground())
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
Z_DOWN = np.diag([1.0, -1, -1])
MISTAKES: dict[str, tuple[World, Callable[[Track], Track], str]] = {
    "gravity up": (World(gravity_m_s2=(0, 0, 9.81), ground=Ground()), lambda t: t, "up is +z"),
    "gravity sideways": (World(gravity_m_s2=(9.81, 0, 0), ground=Ground()), lambda t: t, "up is +z"),
    "gravity in cm": (World(gravity_m_s2=(0, 0, -981.0), ground=Ground()), lambda t: t, "gravity is in centimetres"),
    "times in ms": (LEVEL, lambda t: changed(t, time=1e3), "the times are in milliseconds"),
    "times in ns": (LEVEL, lambda t: changed(t, time=1e9), "the times are in nanoseconds"),
    "numbers of frames": (LEVEL, lambda t: changed(t, time=120), "numbers of frames, of 120"),
    "half the frame rate": (LEVEL, lambda t: changed(t, time=2), "frame rate is 2 times higher"),
    "slow motion": (LEVEL, lambda t: changed(t, time=8), "frame rate is 8 times higher"),
    "tracks in mm": (LEVEL, lambda t: changed(t, length=1e3), "positions are in millimetres"),
    "tracks in cm": (LEVEL, lambda t: changed(t, length=1e2), "positions are in centimetres"),
    "mm taken for cm": (LEVEL, lambda t: changed(t, length=10), "positions are 10 times too large"),
    "mm taken for cm, no ground": (World(), lambda t: changed(t, length=10), "positions are 10 times too large"),
    "y up": (LEVEL, lambda t: changed(t, turn=Y_UP), "up is +y"),
    "z down": (LEVEL, lambda t: changed(t, turn=Z_DOWN), "up is -z"),
    "mirrored z": (LEVEL, lambda t: replace(t, position_m=t.position_m * [1, 1, -1]), "up is -z"),
    "normal down": (World(ground=Ground(normal=(0, 0, -1.0))), lambda t: t, "+z"),
    "normal sideways": (World(ground=Ground(normal=(0, 1.0, 0))), lambda t: t, "+z"),
    "ground above": (World(ground=Ground(offset_m=3.0)), lambda t: t, "the ground is at another height, near"),
}  # fmt: skip


@pytest.mark.parametrize("thing", ["ball", "cube"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_one_mistake_that_explains_the_motion_is_refused_by_name(mistake: str, thing: str, tmp_path: Path) -> None:
    world, change, named = MISTAKES[mistake]
    body, tracks = (ball(), ball_tosses()) if thing == "ball" else (cube(), cube_tosses())
    root = write(tmp_path / "capture", body, world, [change(track) for track in tracks])
    with pytest.raises(InputDataError) as refused:
        Capture.open(root)
    assert named in refused.value.found
    assert "--accept-units" in refused.value.todo
    assert Capture.open(root, accept_units=True).inconsistencies[0].startswith("Accepted with --accept-units")


@pytest.mark.parametrize("factor", [1e3, 1e2])
def test_a_shape_in_another_unit_is_refused(factor: float, tmp_path: Path) -> None:
    body = cube(0.05 * factor).model_copy(update={"mass_kg": None})
    root = write(tmp_path / "capture", body, LEVEL, cube_tosses())
    with pytest.raises(InputDataError, match=r"the shapes are in (milli|centi)metres"):
        Capture.open(root)


def test_a_mass_that_no_body_of_that_size_has_is_refused(tmp_path: Path) -> None:
    root = write(tmp_path / "capture", cube(50.0), World(), cube_tosses())
    with pytest.raises(InputDataError, match=r"0.4 kg in 1e\+06 m3"):
        Capture.open(root)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda q: q[:, [1, 2, 3, 0]], "order x, y, z, w"),
        (lambda q: q * [1, -1, -1, -1], "turn the world into the body"),
    ],
)
def test_quaternions_in_another_order_are_refused(change, named: str, tmp_path: Path) -> None:
    tracks = [replace(track, quat_wxyz=change(track.quat_wxyz)) for track in cube_tosses()]
    root = write(tmp_path / "capture", cube(), LEVEL, tracks)
    with pytest.raises(InputDataError, match=named):
        Capture.open(root)


def turned(world: World, tracks: list[Track], turn: np.ndarray) -> tuple[World, list[Track]]:
    """Return the same motion in another frame."""
    ground = None if world.ground is None else Ground(normal=tuple(turn @ world.ground.normal))
    gravity = tuple(float(x) for x in turn @ np.array(world.gravity_m_s2))
    return World(gravity_m_s2=gravity, ground=ground), [changed(track, turn=turn) for track in tracks]


def ramp(degrees: float) -> tuple[World, list[Track]]:
    angle = np.radians(degrees)
    normal = (float(np.sin(angle)), 0.0, float(np.cos(angle)))
    paths = [
        flight(lambda v, p: EARTH, [0.03 * normal[0], 0.1 * k, 0.03 * normal[2]], [0, 0.1, 0], normal=normal)
        for k in range(4)
    ]
    return World(ground=Ground(normal=normal)), [Track(times, places) for times, places in paths]


def drag(strength: float, weight: float = 1.0) -> Force:
    return lambda v, p: weight * EARTH - strength * np.linalg.norm(v) * v


def carried() -> list[Track]:
    time_s = np.arange(0, 2, 0.01)
    circle = np.stack([0.3 * np.cos(4 * time_s), 0.3 * np.sin(4 * time_s), 0.5 + 0.1 * np.sin(time_s)], 1)
    return [Track(time_s, circle + 0.1 * k) for k in range(4)]


RIGHT: dict[str, Callable[[], tuple[Body, World, list[Track]]]] = {
    "balls": lambda: (ball(), LEVEL, tosses(drag(0.0))),
    "cubes": lambda: (cube(), LEVEL, cube_tosses()),
    "z down": lambda: (cube(), *turned(LEVEL, cube_tosses(), Z_DOWN)),
    "y up": lambda: (cube(), *turned(LEVEL, cube_tosses(), Y_UP)),
    "a ramp of 40 degrees": lambda: (ball(), *ramp(40)),
    "a ramp of 55 degrees": lambda: (ball(), *ramp(55)),
    "a ramp without its ground": lambda: (ball(), World(), ramp(40)[1]),
    "table tennis": lambda: (ball(0.02, 0.0027), LEVEL, tosses(drag(0.15), gap=0.02)),
    "table tennis in strong drag": lambda: (ball(0.02), LEVEL, tosses(drag(0.6), gap=0.02)),
    "a balloon": lambda: (ball(0.12), LEVEL, tosses(drag(1.5, 0.1), 2.0, gap=0.12)),
    "a balloon that rises": lambda: (ball(0.12), LEVEL, tosses(drag(1.5, -0.05), 2.0, gap=0.12)),
    "under water": lambda: (ball(), LEVEL, tosses(drag(8.0, 0.6))),
    "the moon": lambda: (
        ball(), World(gravity_m_s2=(0, 0, -1.62), ground=Ground()), tosses(drag(0.0, 1.62 / 9.81))
    ),
    "the moon, with the Earth's gravity written": lambda: (ball(), LEVEL, tosses(drag(0.0, 1.62 / 9.81))),
    "a bead": lambda: (ball(0.005, 0.004), LEVEL, tosses(drag(0.0), gap=0.005)),
    "a heavy ball": lambda: (ball(0.1, 20.0), LEVEL, tosses(drag(0.0), gap=0.1)),
    "carried": lambda: (ball(), LEVEL, carried()),
    "without gravity": lambda: (ball(), World(), tosses(lambda v, p: 0 * v, bounce=False)),
    "no shape": lambda: (Body(name="thing"), LEVEL, tosses(drag(0.0))),
}  # fmt: skip


@pytest.mark.parametrize("case", RIGHT)
def test_unusual_captures_that_are_right_pass(case: str, tmp_path: Path) -> None:
    body, world, tracks = RIGHT[case]()
    Capture.open(write(tmp_path / "capture", body, world, tracks))


def test_what_is_off_without_a_mistake_is_a_warning_that_names_candidates(tmp_path: Path) -> None:
    root = write(tmp_path / "capture", *RIGHT["under water"]())
    (warning,) = Capture.open(root).inconsistencies
    assert "acceleration is" in warning
    assert "buoyancy" in warning


def test_gravity_that_points_out_of_the_ground_is_refused_without_any_motion(tmp_path: Path) -> None:
    root = write(tmp_path / "capture", cube(), World(gravity_m_s2=(0, 0, 9.81), ground=Ground()), [])
    with pytest.raises(InputDataError, match="points out of the ground"):
        Capture.open(root)
