"""Calibrate photos of one object whose cameras are known, beside COLMAP with each single camera model.

Scanned objects are photographed on a turntable and in hand before black, white and cluttered backgrounds
(`object_photos`); of each set some photos, drawn at random, may be left out. cgwm gets the photos and nothing else.
A run is silently wrong if it writes cameras of which one is beyond 0.3 % of the extent of all true centres, or 1 deg,
by the best similarity of the centres, and no warning says that centres or rotations are uncertain; whether all photos
are registered makes no difference, nor does a warning of anything else. Beside the runs, photos are counted that are
beyond these bars while their own stated errors are below the limits of the warnings.

COLMAP gets the same photos with its defaults and each camera model in turn; the best of them, chosen with the truth, is
the rival. What cgwm says of its own errors (`center_std_percent`, `rotation_std_deg`) stands beside the true ones of
every photo. Run with

    python benchmarks/calibrate_objects.py YCB [--objects mustard_bottle,mug] [--seeds 0,1] [--left-out 0,12]

where YCB is the folder of the scans, `ycb/ycb` of `ycb.tar.xz`.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from calibrate import make_capture
from cgwm.pipeline.calibrate import calibrate
from cgwm.pipeline.calibrate.center_uncertainty import UNCERTAIN_CENTER
from cgwm.pipeline.calibrate.stage import UNCERTAIN_ROTATION_DEG
from cgwm.pipeline.calibrate.world_frame.metric_scale import umeyama
from cgwm.schemas import CalibrateConfig, CalibrationReport, CamerasFile, NotConvergedError, read_json
from mesh_photos import scanned
from object_photos import Session, photograph, poses, write_photos
from scipy.spatial.transform import Rotation
from store import Store

OBJECTS = ("mustard_bottle", "power_drill", "banana", "mug", "rubiks_cube")
LOOKS: tuple[tuple[str, str, float, float, float], ...] = (
    ("black", "turntable", 1500.0, -0.05, 0.0),
    ("black", "hand", 800.0, -0.15, 0.3),
    ("white", "turntable", 800.0, -0.1, 0.3),
    ("white", "hand", 620.0, -0.2, 0.0),
    ("clutter", "hand", 620.0, -0.2, 0.0),
    ("clutter", "turntable", 800.0, -0.1, 0.3),
)
"""Background, motion, focal length [px], radial distortion and gloss."""
PHOTOS = 48
RIVALS = ("SIMPLE_RADIAL", "SIMPLE_PINHOLE", "RADIAL", "OPENCV")
RIGHT_CENTRE_PERCENT, RIGHT_ROTATION_DEG = 0.3, 1.0


def sessions(seed: int, count: int = PHOTOS) -> Iterator[Session]:
    """Yield the ways in which an object is photographed, with one seed and a number of photos."""
    for number, (background, motion, focal, k1, gloss) in enumerate(LOOKS):
        yield Session(
            count=count,
            focal_px=focal,
            k1=k1,
            motion=motion,  # type: ignore[arg-type]
            background=background,  # type: ignore[arg-type]
            gloss=gloss,
            seed=100 * seed + number,
        )


def figures(T_world_cam: dict[str, np.ndarray], truth: np.ndarray) -> dict[str, Any]:
    """Return how many photos are registered, and the largest errors after a similarity alignment of the centres.

    Args:
        T_world_cam: Estimated poses (4, 4) by photo, `007.png`.
        truth: True poses, shape (photo, 4, 4).
    """
    if len(T_world_cam) < 3:
        return {"registered": len(T_world_cam)}
    centre, turn = errors(T_world_cam, truth)
    return {
        "registered": len(T_world_cam),
        "centre_percent": round(float(np.linalg.norm(centre, axis=1).max()), 3),
        "rotation_deg": round(float(np.linalg.norm(turn, axis=1).max()), 3),
    }


def errors(T_world_cam: dict[str, np.ndarray], truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors after a similarity alignment of the centres, in the axes of the object and of each camera.

    Args:
        T_world_cam: Estimated poses (4, 4) by photo, `007.png`.
        truth: True poses, shape (photo, 4, 4).

    Returns:
        Errors of the centres [% of the extent of the true ones], rotation vectors [deg]; each of shape (photo, 3).
    """
    index = [int(Path(name).stem) for name in T_world_cam]
    found, true = np.array(list(T_world_cam.values())), truth[index]
    aligned = umeyama(found[:, :3, 3], true[:, :3, 3])
    extent = np.linalg.norm(np.ptp(truth[:, :3, 3], axis=0))
    centre = (aligned.points(found[:, :3, 3]) - true[:, :3, 3]) / extent
    turn = np.swapaxes(true[:, :3, :3], 1, 2) @ aligned.rotation @ found[:, :3, :3]
    return 100 * centre, Rotation.from_matrix(turn).as_rotvec(degrees=True)


def ours(photos: Path, truth: np.ndarray) -> dict[str, Any]:
    """Calibrate a folder of photos with cgwm."""
    with tempfile.TemporaryDirectory() as folder:
        root = make_capture(photos, Path(folder) / "capture")
        begun = time.process_time()
        try:
            report = calibrate(root, CalibrateConfig())
        except NotConvergedError as error:
            return {"registered": 0, "refused": str(error).splitlines()[0], "cpu_s": round(time.process_time() - begun)}
        cameras = read_json(root / "cameras.json", CamerasFile)
        taken = next(one for one in report.attempts if one.outcome == "taken")
        more = {"model": taken.camera_model, "attempts": len(report.attempts), "warnings": list(report.warnings)}
        estimated = {name: np.array(image.T_world_cam) for name, image in cameras.images.items()}
        estimated = {
            name: pose if len(pose) == 4 else np.vstack([pose, [0, 0, 0, 1]]) for name, pose in estimated.items()
        }
        more |= stated(report, estimated, truth)
        return figures(estimated, truth) | more | {"cpu_s": round(time.process_time() - begun)}


def stated(report: CalibrationReport, T_world_cam: dict[str, np.ndarray], truth: np.ndarray) -> dict[str, Any]:
    """Return the largest standard deviations that a report states, and each photo's beside its true errors.

    Args:
        report: Of `cgwm calibrate`.
        T_world_cam: Its poses (4, 4) by photo.
        truth: True poses, shape (photo, 4, 4).
    """
    verdicts = [report.images[name] for name in T_world_cam]
    stds = np.array([(one.center_std_percent, one.rotation_std_deg) for one in verdicts], float)
    centre, turn = (np.linalg.norm(error, axis=1) for error in errors(T_world_cam, truth))
    columns = {"centre_stds_percent": stds[:, 0], "centre_errors_percent": centre}
    columns |= {"rotation_stds_deg": stds[:, 1], "rotation_errors_deg": turn}
    largest = {"centre_std_percent": stds[:, 0].max(), "rotation_std_deg": stds[:, 1].max()}
    return largest | {name: [round(float(value), 4) for value in values] for name, values in columns.items()}


def theirs(photos: Path, truth: np.ndarray) -> dict[str, Any]:
    """Run COLMAP's own pipeline with its defaults and each camera model; features and matches depend on none."""
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "a.db"
        pycolmap.set_random_seed(0)
        features, matches = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
        features.num_threads = matches.num_threads = 1  # of a worker, which has one processor
        single = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(
            database, photos, camera_mode=single, extraction_options=features, device=pycolmap.Device.cpu
        )
        pycolmap.match_exhaustive(database, matching_options=matches, device=pycolmap.Device.cpu)
        return {"models": {model: _mapped(database, photos, truth, model) for model in RIVALS}}


def _mapped(database: Path, photos: Path, truth: np.ndarray, model: str) -> dict[str, Any]:
    begun, output = time.process_time(), database.with_suffix(f".{model}")
    output.mkdir()
    opened = pycolmap.Database.open(database)
    try:
        for camera in opened.read_all_cameras():
            size = camera.width, camera.height
            # 1.2 of the longer side is COLMAP's guess of a focal length
            opened.update_camera(
                pycolmap.Camera.create_from_model_name(camera.camera_id, model, 1.2 * max(size), *size)
            )
    finally:
        opened.close()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    found = pycolmap.incremental_mapping(database, photos, output, options)
    if not found:
        return {"registered": 0}
    largest = max(found.values(), key=lambda one: one.num_reg_images())
    estimated = {}
    for image in largest.images.values():
        if image.has_pose:
            estimated[image.name] = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
    return figures(estimated, truth) | {"cpu_s": round(time.process_time() - begun)}


def right(row: dict[str, Any], photos: int) -> bool:
    """Return whether all of a number of photos are registered where they were taken."""
    return (
        row["registered"] == photos
        and row["centre_percent"] <= RIGHT_CENTRE_PERCENT
        and row["rotation_deg"] <= RIGHT_ROTATION_DEG
    )


def wrong(row: dict[str, Any]) -> bool:
    """Return whether cameras are written and one of them is not where its photo was taken."""
    return row["registered"] > 0 and (
        row.get("centre_percent", np.inf) > RIGHT_CENTRE_PERCENT or row.get("rotation_deg", np.inf) > RIGHT_ROTATION_DEG
    )


def hidden_photos(row: dict[str, Any]) -> int:
    """Return how many photos are not where they were taken, while their own stated errors give no warning."""
    if "centre_errors_percent" not in row:
        return 0
    off = np.array(row["centre_errors_percent"]) > RIGHT_CENTRE_PERCENT
    off |= np.array(row["rotation_errors_deg"]) > RIGHT_ROTATION_DEG
    stated = np.array(row["centre_stds_percent"]) > 100 * UNCERTAIN_CENTER
    stated |= np.array(row["rotation_stds_deg"]) > UNCERTAIN_ROTATION_DEG
    return int((off & ~stated).sum())


def _said(row: dict[str, Any]) -> bool:
    return any("optical centres of" in one or "rotations of" in one for one in row["warnings"])


def photos_of(ycb: Path, folder: Path, name: str, session: Session) -> tuple[Path, np.ndarray]:
    """Return the folder of an object's photos, made unless it is there, and the true poses (photo, 4, 4)."""
    painted = scanned(ycb / name)
    made = (folder / f"{name}-{session.background}-{session.motion}-{session.seed}-{session.count}").resolve()
    if not made.is_dir():
        new = Path(tempfile.mkdtemp(dir=made.parent)) / "photos"
        write_photos(new, photograph(painted, session)[0])
        with contextlib.suppress(OSError):  # another process was faster
            new.rename(made)
    return made, np.array(poses(session, painted.mesh))


@contextlib.contextmanager
def kept(photos: Path, session: Session, left_out: int) -> Iterator[Path]:
    """Yield a folder with links to all photos but some, which are drawn at random."""
    with tempfile.TemporaryDirectory() as folder:
        drawn = np.random.default_rng([session.seed, 7]).permutation(session.count)[left_out:]
        for k in sorted(drawn):
            (Path(folder) / f"{k:03d}.png").symlink_to(photos / f"{k:03d}.png")
        yield Path(folder)


def measured(ycb: Path, folder: Path, name: str, session: Session, left_out: int, contender: str) -> dict[str, Any]:
    """Calibrate one set of photos with cgwm, or with COLMAP."""
    _on_one_processor()
    pycolmap.logging.minloglevel = 3
    made, truth = photos_of(ycb, folder, name, session)
    with kept(made, session, left_out) as photos:
        found = ours(photos, truth) if contender == "cgwm" else theirs(photos, truth)
    return {"photos": session.count - left_out} | found


def _on_one_processor() -> None:
    """Keep a worker to one of the processors, so that none waits for another: results take minutes each."""
    number = multiprocessing.current_process().name.rpartition("-")[2]
    if number.isdecimal() and hasattr(os, "sched_setaffinity"):
        processors = sorted(os.sched_getaffinity(os.getppid()))
        os.sched_setaffinity(0, {processors[int(number) % len(processors)]})


def main() -> int:
    """Print one JSON line a run, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ycb", type=Path)
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--count", type=int, default=PHOTOS, help="photos of a set")
    parser.add_argument("--left-out", default="0", help="numbers of photos that are left out of each set")
    parser.add_argument("--photos", type=Path, default=Path("out/object-photos"), help="where the photos are kept")
    parser.add_argument("--contenders", default="cgwm,COLMAP")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--results", type=Path, help="file of the results, in out/evidence/ where left out")
    arguments = parser.parse_args()
    arguments.photos.mkdir(parents=True, exist_ok=True)
    store = Store("calibrate_objects", arguments.results, any_commit=True)
    names, seeds, left_out = (text.split(",") for text in (arguments.objects, arguments.seeds, arguments.left_out))
    sets = {
        _key(name, session, seed, fewer): (arguments.ycb, arguments.photos, name, session, fewer)
        for seed in map(int, seeds)
        for name in names
        for session in sessions(seed, arguments.count)
        for fewer in map(int, left_out)
    }
    store.fill(measured, _in_order(sets, arguments.contenders.split(",")), arguments.workers)
    rows = [(mine, store.known(f"{key} COLMAP")) for key in sets if (mine := store.known(f"{key} cgwm")) is not None]
    print_counts(rows)
    return 0


def _key(name: str, session: Session, seed: int, left_out: int) -> str:
    words = f"{name} {session.background} {session.motion} {seed}"
    words += "" if session.count == PHOTOS else f" of {session.count}"
    return f"{words} without {left_out}" if left_out else words


def _in_order(sets: dict[str, Any], contenders: list[str]) -> dict[str, Any]:
    """Return the arguments of each result: sets in an order drawn once for all, those first that take longest.

    COLMAP takes a table that stands for what turns, and ten times as long as elsewhere: these results come last.
    """
    keys = [list(sets)[k] for k in np.random.default_rng(0).permutation(len(sets))]
    pairs = [(key, one) for one in contenders for key in keys]
    # sets of which some photos are left out come when the photos of all are drawn
    pairs.sort(key=lambda pair: (_late(*pair), "clutter" not in pair[0], pair[1] != "cgwm", " without " in pair[0]))
    return {f"{key} {one}": (*sets[key], one) for key, one in pairs}


def _late(key: str, contender: str) -> bool:
    return contender != "cgwm" and "clutter turntable" in key


def print_counts(rows: list[tuple[dict[str, Any], dict[str, Any] | None]]) -> None:
    """Print how many sets are right, of those that COLMAP solves and of all, and how wrong ones were written."""
    mine, ok = [row for row, _ in rows], [right(row, row["photos"]) for row, _ in rows]
    both = [(good, other) for (_, other), good in zip(rows, ok, strict=True) if other is not None]
    solved = [good for good, other in both if any(right(one, other["photos"]) for one in other["models"].values())]
    print(f"right: cgwm {sum(ok)} of {len(mine)}")
    print(f"COLMAP with its best model {len(solved)} of {len(both)}, of these cgwm {sum(solved)}")
    bad = [row for row in mine if wrong(row)]
    silent = sum(not _said(row) for row in bad)
    print(f"written: {sum(row['registered'] > 0 for row in mine)}, of these with a photo beyond the bars: {len(bad)}")
    print(f"silently wrong: {silent} of {len(mine)}")
    print(f"photos beyond the bars whose own stated errors give no warning: {sum(map(hidden_photos, mine))}")
    print(f"right with such a warning: {sum(good and _said(row) for row, good in zip(mine, ok, strict=True))}")
    for part in ("centre", "rotation"):
        unit = "percent" if part == "centre" else "deg"
        pairs = [
            (row[f"{part}_errors_{unit}"], row[f"{part}_stds_{unit}"]) for row in mine if f"{part}_stds_{unit}" in row
        ]
        if pairs:
            errors, stds = (np.concatenate(columns) for columns in zip(*pairs, strict=True))
            within = [100 * float((errors <= times * stds).mean()) for times in (1, 2)]
            print(f"{part}: {within[0]:.0f} and {within[1]:.0f} % of photos within one and two stated errors")


if __name__ == "__main__":
    sys.exit(main())
