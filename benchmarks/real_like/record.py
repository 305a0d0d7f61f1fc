"""The capture of a real-like case, and the truth beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Track, tracks_csv
from cgwm.datasets.io.atomic import new_directory, new_file
from cgwm.datasets.synthetic.hidden_effects import EFFECTS
from cgwm.datasets.synthetic.hidden_effects.case import Case
from cgwm.datasets.synthetic.hidden_effects.mechanics import Hidden, Mechanics, Motion, Start, build
from cgwm.datasets.synthetic.hidden_effects.protocol import draw_start, motions
from cgwm.datasets.synthetic.hidden_effects.record import poses
from cgwm.datasets.synthetic.hidden_effects.rotation import rotation_of
from cgwm.datasets.synthetic.hidden_effects.things import Array, Thing
from cgwm.schemas import Body, BoxShape, CaptureManifest, Ground, Shape, World
from cgwm.schemas.capture import Episode, SphereShape
from scipy.spatial.transform import Rotation

from .engines import GROUPS
from .errors import SESSIONS, Errors, draw_errors, noise, seen, session_scales, smooth
from .plan import RealCase
from .sizes import Bench, Sized, sized_effect


def make_real_capture(directory: Path, case: RealCase, truth: Path | None = None, overwrite: bool = False) -> Path:
    """Write the capture of a case, and the truth beside it; return the file of the truth.

    Args:
        directory: The capture to write; nothing in it tells what is hidden.
        case: What to make.
        truth: Where the truth goes; default `<directory>.truth.json`.
        overwrite: Replace both.
    """
    path = truth or directory.with_name(f"{directory.name}.truth.json")
    engine, body = GROUPS[case.group][0], case.body_case()
    thing, errors = body.drawn_thing(), draw_errors(case.rng("errors"), body.rate_hz)
    world = Mechanics.of(thing, body.law)
    kinds = motions(body.protocol, body.train, body.test)
    starts = [draw_start(thing, kind, case.rng(f"start {k}")) for k, kind in enumerate(kinds)]
    bench = Bench(
        thing=thing,
        world=world,
        simulate=engine.simulate,
        episodes=list(zip(kinds, starts, strict=True))[: body.train],
        length_s=body.length_s,
        errors=errors,
        turned=not body.centroid_only,
    )
    sized = [sized_effect(name, bench, [case.seed, *name.encode()]) for name in case.effects]
    hidden, scales = [one.effect for one in sized], session_scales(errors, case.rng("sessions"))
    built, names = build(world, hidden), [f"{k:03d}" for k in range(len(kinds))]
    groups = {name: SESSIONS[k % 2] for k, name in enumerate(names)}
    episodes: dict[str, Any] = {}
    with new_directory(directory, "capture", overwrite) as folder:
        write_manifest(folder / "capture.toml", _manifest(body, thing, names, groups))
        (folder / "tracks").mkdir()
        for name, kind, start in zip(names, kinds, starts, strict=True):
            motion = engine.simulate(built, hidden, start, body.length_s)
            track, did = _measured(body, errors, hidden, motion, start, kind, scales[groups[name]], case.rng(name))
            (folder / "tracks" / f"{name}.csv").write_text(tracks_csv({case.thing: track}), encoding="utf-8")
            touched = motion.time_s[motion.touching]
            first = float(touched[0]) + did["release_s"] if touched.size else None
            episodes[name] = {"motion": kind, "session": groups[name], "first_contact_s": first, **did}
    with new_file(path, "truth", overwrite) as temporary:
        text = json.dumps(_truth(case, body, thing, errors, sized, episodes), indent=1)
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def _measured(
    body: Case, errors: Errors, hidden: list[Hidden], motion: Motion, start: Start, kind: str, scale: float,
    rng: np.random.Generator,
) -> tuple[Track, dict[str, Any]]:  # fmt: skip
    """Return what is measured of a motion, and what the measurement did."""
    clock = float(np.prod([effect.clock for effect in hidden]))
    held_s = float(rng.uniform(0.03, 0.12)) if errors.hand else 0.0
    carried = int(np.floor(held_s * clock * body.rate_hz))
    count = carried + int(np.floor(body.length_s * clock * body.rate_hz + 1e-9)) + 1
    times = np.arange(count) / body.rate_hz
    true_s = (times - carried / body.rate_hz) / clock
    position, rotation = poses(motion, true_s.clip(0.0))
    before = true_s < 0
    position[before], rotation[before] = _in_a_hand(start, kind, true_s[before], rng)
    for effect in hidden:
        if effect.observe:
            position, rotation = effect.observe(position, rotation)
    position, rotation, did = seen(errors, position, rotation, scale, rng)
    metres, angles, bursts = noise(errors, times, rng)
    quat = (Rotation.from_matrix(rotation) * Rotation.from_rotvec(angles)).as_quat(scalar_first=True)
    quat *= np.concatenate([[1.0], np.cumprod(np.sign((quat[1:] * quat[:-1]).sum(1)))])[:, None]
    both = smooth(errors, np.hstack((position + metres, quat)), body.rate_hz)
    quat = both[:, 3:] / np.linalg.norm(both[:, 3:], axis=1, keepdims=True)
    track = Track(times, both[:, :3], None if body.centroid_only else quat)
    return track, {"release_s": carried / body.rate_hz, "bursts_s": bursts, **did}


def _in_a_hand(start: Start, kind: str, before_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return poses while a hand carries a body towards its first state, at negative times: by even accelerations.

    A body that is dropped is held still; one that is thrown comes from rest, or nearly; on the ground it is pushed
    along it.
    """
    duration = max(-float(before_s.min(initial=0.0)), 1e-9)
    turned = rotation_of(start.quat_wxyz)
    if kind == "drop":
        return np.tile(start.position_m, (len(before_s), 1)), np.tile(turned, (len(before_s), 1, 1))
    share = rng.uniform(0.6, 1.0)  # of its speed that the hand gives it within the time that is seen
    along = before_s + share * before_s**2 / (2 * duration)
    upright = np.array([1.0, 1.0, float(kind == "throw")])
    position = start.position_m + along[:, None] * start.velocity_m_s * upright
    vectors = along[:, None] * start.omega_body_rad_s
    return position, turned @ Rotation.from_rotvec(vectors).as_matrix()


def _manifest(body: Case, thing: Thing, names: list[str], groups: dict[str, str]) -> CaptureManifest:
    x, y, z = (float(value) for value in thing.half_extents_m)
    ball, box = SphereShape(radius_m=x), BoxShape(half_extents_m=(x, y, z))
    shape = Shape(sphere=ball) if thing.kind == "ball" else Shape(box=box)
    return CaptureManifest(
        format="cgwm-capture/1",
        world=World(ground=Ground()),
        bodies=(Body(name=body.thing, mass_kg=thing.mass_kg, shape=shape),),
        episodes={name: Episode(group=group) for name, group in groups.items()},
        splits={"train": tuple(names[: body.train]), "test": tuple(names[body.train :])},
    )


def _truth(
    case: RealCase, body: Case, thing: Thing, errors: Errors, sized: list[Sized], episodes: dict[str, Any]
) -> dict[str, Any]:
    facts = GROUPS[case.group][0].facts(thing)
    return {
        "format": "real-like-truth/1",
        "name": case.name,
        "row": case.row,
        "group": case.group,
        "engine_name": case.engine,
        "thing": case.thing,
        "seed": case.seed,
        "protocol": body.protocol,
        "rate_hz": body.rate_hz,
        "centroid_only": body.centroid_only,
        "effects": [
            {
                "name": one.effect.name,
                "values": one.effect.values,
                "form": one.effect.form,
                "unknown": EFFECTS[one.effect.name].acts == "unknown",
                "comes_with": list(one.effect.comes_with),
                **one.facts(),
            }
            for one in sized
        ],
        "errors": errors.facts(),
        "body": {
            "half_extents_m": thing.half_extents_m.tolist(),
            "mass_kg": thing.mass_kg,
            "friction": thing.friction,
            "damping_ratio": thing.damping_ratio,
        },
        "engine": facts,
        "episodes": episodes,
    }
