"""Makes one capture: photos at rest, one short episode to train on, long ones to test on, and all that is true."""

from __future__ import annotations

import zlib
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from cgwm.datasets.io.atomic import new_directory
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import rest_pose
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.datasets.synthetic.record import build_set, record
from cgwm.schemas import InputDataError, UsageError, did_you_mean

from .draft import NO_DRAFT, Draft
from .engines import ENGINES, refusal
from .materials import MATERIALS
from .objects import OBJECTS, Item, load_item
from .plan import FRAME_RATE
from .pushes import PUSH, TIP, plan_strikes
from .tosses import plan_tosses

Task = Literal["fall", "push", "tip"]
PLANS = {"fall": plan_tosses, "push": partial(plan_strikes, PUSH), "tip": partial(plan_strikes, TIP)}
TASKS: tuple[Task, ...] = ("fall", "push", "tip")
PARTS_FILE = "truth_parts.npz"
_SAMPLES = 2  # at each of the three moments of an exposure
_STILL = 3e-5  # metres and entries of quaternions: a fiftieth of a pixel


def make_capture(
    folder: Path,
    obj: str,
    material: str,
    task: Task,
    seed: int = 0,
    tests: int = 10,
    video_size: tuple[int, int] = (320, 240),
    photo_size: tuple[int, int] = (640, 480),
    photos: int = 48,
    overwrite: bool = False,
    engine: str = "mujoco",
    tests_every: int = 1,
    draft: Draft = NO_DRAFT,
) -> Path:
    """Make a capture; the same arguments give the same bytes.

    The photos, the cameras and the light depend on the object and the seed alone. Prints how many drawn motions were
    left out, and why.

    Args:
        folder: Directory that takes the capture.
        obj: One of `OBJECTS`.
        material: One of `MATERIALS`.
        task: One of `TASKS`.
        seed: Draws motion, cameras, light and noise.
        tests: Number of test episodes.
        video_size: Width and height of the video frames [px].
        photo_size: Width and height of the photos [px].
        photos: Number of photos.
        overwrite: Replace what is at `folder`.
        engine: Whose motions are the truth, one of `ENGINES`. Natural time and damping ratio of truth.json are those
            that its contacts were made from; only MuJoCo has them as such.
        tests_every: Frames of test videos that are drawn, see `Set`. One of a scanned object takes 0.16 s, and no
            contender sees one.
        draft: Keeps the motions that are drawn, and has those that were; nothing of a capture depends on it.

    Returns:
        `folder` as a path.

    Raises:
        UsageError: If a name or a number is not allowed, or `folder` exists.
        InputDataError: If a scanned object is not in the cache and cannot be made.
        NotConvergedError: If no motion could be drawn that serves.
    """
    names = (("object", obj, OBJECTS), ("material", material, MATERIALS), ("task", task, TASKS))
    for kind, value, allowed in (*names, ("engine", engine, ENGINES)):
        if value not in allowed:
            raise UsageError(f"unknown {kind} '{value}'.", ", ".join(allowed) + "." + did_you_mean(value, allowed))
    item = load_item(obj)
    plan, rejected = plan_capture(item, obj, material, task, seed, tests, engine, draft)
    print(f"{obj} {material} {task} {engine}: draws left out: {rejected or 'none'}", flush=True)
    with new_directory(Path(folder), "capture", overwrite) as directory:
        stage = build_set(plan, photo_size, video_size, photos, item.paint, item.scan, _SAMPLES, _STILL, tests_every)
        record(stage, directory)
        cameras = read_truth(directory).cameras
        (directory / "cameras.json").write_text(cameras.model_dump_json(indent=1) + "\n", encoding="utf-8")
        write_parts(directory / PARTS_FILE, item.solid)
    return Path(folder)


def plan_capture(
    item: Item,
    obj: str,
    material: str,
    task: Task,
    seed: int,
    tests: int,
    engine: str = "mujoco",
    draft: Draft = NO_DRAFT,
) -> tuple[ScenePlan, dict[str, int]]:
    """Draw every episode's true motion; nothing is rendered. Also returns the numbers of draws left out, by reason.

    What is drawn does not depend on the engine, but what is left out does.

    Raises:
        UsageError: If the engine cannot simulate the object, or is not installed.
        NotConvergedError: If no motion serves.
    """
    reason = refusal(engine, item.solid)
    if reason is not None:
        raise UsageError(f"the engine {engine} cannot simulate {obj}: {reason}.", ", ".join(ENGINES) + ".")
    scene_seed = zlib.crc32(f"{obj}/{seed}".encode())
    rng = np.random.default_rng([scene_seed, 20])
    photo_qpos = rest_pose(item.solid, item.down, rng.uniform(-np.pi, np.pi), *rng.uniform(-0.01, 0.01, 2))
    rng = np.random.default_rng([scene_seed, 21, zlib.crc32(f"{material}/{task}".encode())])
    contact = MATERIALS[material]
    make = ENGINES[engine].make
    episodes, rejected = PLANS[task](rng, scene_seed, item.solid, item.down, contact, tests, make, draft)
    fingertip = task != "fall"
    plan = ScenePlan(
        name=task,
        seed=scene_seed,
        solid=item.solid,
        contact=contact,
        photo_qpos=photo_qpos,
        frame_rate=FRAME_RATE,
        episodes=episodes,
        fingertip=fingertip,
    )
    return plan, rejected


def write_parts(path: Path, solid: SolidObject) -> None:
    """Write all of a solid but its colours: `truth_parts.npz`."""
    ends = np.cumsum([len(part) for part in solid.parts])
    np.savez_compressed(
        path, family=solid.family, vertices=solid.vertices, faces=solid.faces, parts=np.concatenate(solid.parts),
        part_ends=ends, mass_kg=solid.mass, com_m=solid.com, inertia_kg_m2=solid.inertia,
    )  # fmt: skip


def read_solid(folder: Path) -> SolidObject:
    """Read the true object of a capture: `build_model(read_solid(folder), contact, fingertip)` is its true model.

    Args:
        folder: The capture.

    Raises:
        InputDataError: If the capture has none.
    """
    path = Path(folder) / PARTS_FILE
    if not path.exists():
        raise InputDataError(f"{path}: missing.", "a capture that `make_capture` wrote.")
    with np.load(path) as file:
        parts = np.split(file["parts"], file["part_ends"][:-1])
        return SolidObject(
            family=str(file["family"]), vertices=file["vertices"], faces=file["faces"], parts=tuple(parts),
            mass=float(file["mass_kg"]), com=file["com_m"], inertia=file["inertia_kg_m2"],
        )  # fmt: skip
