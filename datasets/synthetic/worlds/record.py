"""The capture of a world: meshes, manifest and measured tracks, and beside them the truth."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ....schemas import CAPTURE_FORMAT, Body, CaptureManifest, Measurement, World
from ....schemas.capture import Material, MaterialPair
from ...capture.manifest import write_manifest
from ...capture.tracks import Track, write_tracks
from ..objects import write_obj
from .scene import GRAVITY_M_S2, Array, WorldContact, WorldEpisode, WorldPlan
from .truth_engine import STEPS_PER_S, build_model, simulate

TRUTH_FILE = "truth.json"
TRACK_HZ = 120
POSITION_STD_M, ROTATION_STD_RAD = 0.0003, 0.003
"""Standard deviations of the tracker: of the position along each axis, of the rotation about each axis."""


def record(plan: WorldPlan, out: Path) -> None:
    """Write the whole capture into the empty directory `out`."""
    for thing in plan.things:
        if thing.solid is not None:
            write_obj(out / f"{thing.name}.obj", thing.solid)
    model = build_model(plan)
    (out / "tracks").mkdir()
    for episode in plan.episodes:
        poses = simulate(plan, model, episode, TRACK_HZ)
        write_tracks(out / "tracks" / f"{episode.name}.csv", _measured(plan, episode, poses))
    write_manifest(out / "capture.toml", _manifest(plan))
    (out / TRUTH_FILE).write_text(json.dumps(_truth(plan), indent=1) + "\n", encoding="utf-8")


def _measured(plan: WorldPlan, episode: WorldEpisode, poses: Array) -> dict[str, Track]:
    """Return the tracks of the bodies, with normal noise."""
    rng = np.random.default_rng([plan.seed, zlib.crc32(episode.name.encode())])
    times = np.arange(len(poses)) / TRACK_HZ
    tracks = {}
    for k, thing in enumerate(plan.things):
        turns = Rotation.from_rotvec(ROTATION_STD_RAD * rng.standard_normal((len(poses), 3)))
        quats = (Rotation.from_quat(poses[:, k, 3:], scalar_first=True) * turns).as_quat(scalar_first=True)
        places = poses[:, k, :3] + POSITION_STD_M * rng.standard_normal((len(poses), 3))
        tracks[thing.name] = Track(times, np.round(places, 7), np.round(quats, 9))
    return tracks


def _manifest(plan: WorldPlan) -> CaptureManifest:
    materials = sorted({name for pair in plan.contact.friction for name in pair})
    bodies = [
        Body(
            name=thing.name,
            mass_kg=thing.mass_kg,
            shape=thing.shape,
            photo_pose=thing.place,
            material=plan.material,
        )
        for thing in plan.things
    ]
    splits: dict[str, tuple[str, ...]] = {}
    for episode in plan.episodes:
        splits[episode.split] = (*splits.get(episode.split, ()), episode.name)
    return CaptureManifest(
        format=CAPTURE_FORMAT,
        world=World(gravity_m_s2=(0.0, 0.0, -GRAVITY_M_S2), ground=plan.ground),
        bodies=tuple(bodies),
        surfaces=plan.surfaces,
        materials=tuple(Material(name=name) for name in materials),
        pairs=tuple(_pair(plan.contact, pair) for pair in plan.contact.friction),
        measurement=Measurement(position_std_m=POSITION_STD_M, rotation_std_rad=ROTATION_STD_RAD),
        splits=splits,
    )


def _pair(contact: WorldContact, pair: tuple[str, str]) -> MaterialPair:
    if not contact.stated:
        return MaterialPair(materials=pair)
    return MaterialPair(
        materials=pair,
        friction=contact.friction[pair],
        contact_time_s=contact.natural_time_s,
        damping_ratio=contact.damping_ratio,
    )


def _truth(plan: WorldPlan) -> dict[str, object]:
    return {
        "format": "cgwm-world-truth/1",
        "scene": plan.name,
        "seed": plan.seed,
        "friction": {",".join(pair): value for pair, value in plan.contact.friction.items()},
        "natural_time_s": plan.contact.natural_time_s,
        "damping_ratio": plan.contact.damping_ratio,
        "timestep_s": 1 / STEPS_PER_S,
    }
