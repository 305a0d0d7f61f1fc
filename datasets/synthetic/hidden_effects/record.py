"""A capture of a case as a user would have it, and the truth beside it in a file of its own."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas import Body, BoxShape, CaptureManifest, Ground, Shape, World
from ....schemas.capture import Measurement, SphereShape
from ....schemas.regular_files import real_path
from ...capture.manifest import write_manifest
from ...capture.tracks import Track, tracks_csv
from ...io.atomic import new_directory, new_file
from . import mechanics, mujoco_engine
from .case import Case
from .mechanics import Hidden, Mechanics, Motion
from .protocol import draw_start, motions
from .rotation import rotations
from .things import Array, Thing, restitution_of

ENGINES: dict[str, Any] = {"mujoco": mujoco_engine}
"""The truths by name, modules with `simulate` and `facts`; the benchmark enters a second one."""


def make_capture(directory: Path | str, case: Case, truth: Path | str | None = None, overwrite: bool = False) -> Path:
    """Write the capture of a case, and the truth beside it.

    Args:
        directory: The capture to write; nothing in it tells what is hidden, its name included if you choose it well.
        case: What to make.
        truth: Where the truth goes; default `<directory>.truth.json`, beside the capture and not in it.
        overwrite: Replace both.

    Returns:
        The file of the truth.

    Raises:
        ValueError: If the truth would lie in the capture, or there is no such engine.
    """
    directory = Path(directory)
    path = Path(truth) if truth is not None else directory.with_name(f"{directory.name}.truth.json")
    if real_path(path).is_relative_to(real_path(directory)):
        raise ValueError(f"the truth {path} would lie in the capture {directory}")
    if case.engine not in ENGINES:
        raise ValueError(f"no engine '{case.engine}'; there are {', '.join(ENGINES)}")
    thing, hidden = case.drawn_thing(), case.drawn_effects()
    world = mechanics.build(Mechanics.of(thing, case.law), hidden)
    engine = ENGINES[case.engine]
    kinds = motions(case.protocol, case.train, case.test)
    names = [f"{k:03d}" for k in range(len(kinds))]
    episodes: dict[str, Any] = {}
    with new_directory(directory, "capture", overwrite) as folder:
        write_manifest(folder / "capture.toml", _manifest(case, thing, names))
        (folder / "tracks").mkdir()
        for name, kind in zip(names, kinds, strict=True):
            start = draw_start(thing, kind, case.rng(f"start {name}"))
            motion = engine.simulate(world, hidden, start, case.length_s)
            track, wrong = measured(case, hidden, motion, case.rng(f"noise {name}"))
            (folder / "tracks" / f"{name}.csv").write_text(tracks_csv({case.thing: track}), encoding="utf-8")
            touched = motion.time_s[motion.touching]
            episodes[name] = {
                "motion": kind,
                "first_contact_s": float(touched[0]) if touched.size else None,
                "in_contact": float(motion.touching.mean()),
                "outlier_times_s": track.time_s[wrong].tolist(),
            }
    with new_file(path, "truth", overwrite) as temporary:
        temporary.write_text(json.dumps(_truth(case, thing, hidden, episodes), indent=1) + "\n", encoding="utf-8")
    return path


def measured(
    case: Case, hidden: list[Hidden], motion: Motion, rng: np.random.Generator
) -> tuple[Track, NDArray[np.bool_]]:
    """Return what is measured of a motion: sampled, seen with the effects on the measurement, with noise and gaps.

    Between two steps of the engine (0.2 ms) poses are interpolated linearly, which is exact to 1e-8 m.

    Returns:
        The track, and which of its samples are outliers (T,).
    """
    clock = float(np.prod([effect.clock for effect in hidden]))
    count = int(np.floor(case.length_s * clock * case.rate_hz + 1e-9)) + 1
    times = np.arange(count, dtype=float)
    times[1:-1] += case.uneven * rng.uniform(-1, 1, max(count - 2, 0))
    times /= case.rate_hz
    position, rotation = poses(motion, times / clock)
    for effect in hidden:
        if effect.observe:
            position, rotation = effect.observe(position, rotation)
    position = position + case.position_std_m * _errors(case, count, rng)
    quat = _with_noise(rotation, case.rotation_std_rad * _errors(case, count, rng))
    if case.smoothed:
        position, quat = _smoothed(position, case.smoothed), _smoothed(_continuous(quat), case.smoothed)
        quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    wrong = rng.random(count) < case.outliers
    gross = rng.standard_normal((count, 3))
    gross /= np.linalg.norm(gross, axis=1, keepdims=True)
    position[wrong] += (rng.uniform(0.02, 0.1, (count, 1)) * gross)[wrong]
    thrown = _with_noise(rotations(quat), np.radians(rng.uniform(20, 60, (count, 1))) * gross)
    quat[wrong] = thrown[wrong]
    keep = np.ones(count, bool)
    for _ in range(case.gaps):
        first = int(rng.integers(1, max(count - 9, 2)))
        keep[first : first + int(rng.integers(3, 9))] = False
    keep[-1] = True
    track = Track(times[keep], position[keep], None if case.centroid_only else quat[keep])
    return track, wrong[keep]


def poses(motion: Motion, times: Array) -> tuple[Array, Array]:
    """Return positions (T, 3) and rotations (T, 3, 3) at true times."""
    row = np.searchsorted(motion.time_s, times, side="right").clip(1, len(motion.time_s) - 1)
    before, after = motion.time_s[row - 1], motion.time_s[row]
    share = ((times - before) / (after - before))[:, None]
    position = (1 - share) * motion.position_m[row - 1] + share * motion.position_m[row]
    quat = (1 - share) * motion.quat_wxyz[row - 1] + share * motion.quat_wxyz[row]
    return position, rotations(quat / np.linalg.norm(quat, axis=1, keepdims=True))


def _errors(case: Case, count: int, rng: np.random.Generator) -> Array:
    """Return errors (T, 3) of variance 1, of which the next frame has a share left."""
    fresh = rng.standard_normal((count, 3))
    for frame in range(1, count if case.lasting else 0):
        fresh[frame] = case.lasting * fresh[frame - 1] + np.sqrt(1 - case.lasting**2) * fresh[frame]
    return fresh


def _smoothed(values: Array, window: int) -> Array:
    from scipy.signal import savgol_filter

    return np.asarray(savgol_filter(values, window, 2, axis=0))


def _continuous(quat: Array) -> Array:
    """Return quaternions (T, 4) of which none has the other sign than the one before."""
    flips = np.sign((quat[1:] * quat[:-1]).sum(1))
    return quat * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _with_noise(rotation: Array, vector: Array) -> Array:
    """Return the quaternions (T, 4) of rotations (T, 3, 3) followed by rotation vectors (T, 3) [rad] in body axes."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(rotation) * Rotation.from_rotvec(vector)
    return turned.as_quat(scalar_first=True)


def _manifest(case: Case, thing: Thing, names: list[str]) -> CaptureManifest:
    x, y, z = (float(value) for value in thing.half_extents_m)
    ball, box = SphereShape(radius_m=x), BoxShape(half_extents_m=(x, y, z))
    shape = Shape(sphere=ball) if thing.kind == "ball" else Shape(box=box)
    moments = tuple(float(value) for value in thing.inertia_kg_m2)
    body = Body(
        name=case.thing,
        mass_kg=thing.mass_kg if case.mass_given else None,
        inertia_kg_m2=moments if case.inertia_given else None,
        com_m=(0.0, 0.0, 0.0) if case.inertia_given else None,
        shape=shape,
    )
    noise = Measurement(position_std_m=case.position_std_m, rotation_std_rad=case.rotation_std_rad)
    return CaptureManifest(
        format="cgwm-capture/1",
        world=World(ground=Ground()),
        bodies=(body,),
        measurement=noise if case.noise_given else Measurement(),
        splits={"train": tuple(names[: case.train]), "test": tuple(names[case.train :])},
    )


def _truth(case: Case, thing: Thing, hidden: list[Hidden], episodes: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": "hidden-effects-truth/1",
        "case": asdict(case),
        "effects": [
            {
                "name": effect.name,
                "values": {key: _plain(value) for key, value in effect.values.items()},
                "form": effect.form,
                "comes_with": list(effect.comes_with),
            }
            for effect in hidden
        ],
        "body": {
            "half_extents_m": thing.half_extents_m.tolist(),
            "mass_kg": thing.mass_kg,
            "inertia_kg_m2": thing.inertia_kg_m2.tolist(),
        },
        "contact": {
            "friction": thing.friction,
            "natural_time_s": thing.natural_time_s,
            "damping_ratio": thing.damping_ratio,
            "restitution": float(restitution_of(thing.damping_ratio)),
        },
        "engine": ENGINES[case.engine].facts(thing),
        "episodes": episodes,
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, list) else float(value)
