"""Calibrate real photos, and print how right and how repeatable the cameras are.

`fox`: camera centres against its transforms.json (itself a COLMAP result: agreement, not truth) after a similarity
alignment, from three seeds, twice each. `kermit`: how many photos are registered. Run with

    python benchmarks/calibrate.py [--seeds 0,1,2] [--max-features 4096]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.pipeline.calibrate import calibrate
from cgwm.pipeline.calibrate.world_frame.metric_scale import umeyama
from cgwm.schemas import CalibrateConfig, CamerasFile, read_json
from store import Store, shared_data

MANIFEST = 'format = "cgwm-capture/1"\n'


def make_capture(photos: Path, folder: Path) -> Path:
    """Make a capture of a folder of photos, without copying them."""
    (folder / "images").mkdir(parents=True)
    for photo in sorted([*photos.glob("*.jpg"), *photos.glob("*.png")]):
        (folder / "images" / photo.name).symlink_to(photo.resolve())
    (folder / "capture.toml").write_text(MANIFEST, encoding="utf-8")
    return folder


def center_errors(cameras: CamerasFile, transforms: dict[str, Any]) -> np.ndarray:
    """Return centre errors against a transforms.json, as fractions of the diagonal of its cameras' bounding box."""
    reference = {
        Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3, 3] for frame in transforms["frames"]
    }
    names = [name for name in cameras.images if name in reference]
    found = np.array([cameras.images[name].T_world_cam for name in names])[:, :3, 3]
    target = np.array([reference[name] for name in names])
    diagonal = np.linalg.norm(np.ptp(np.array(list(reference.values())), axis=0))
    return np.linalg.norm(umeyama(found, target).points(found) - target, axis=1) / diagonal


def run_once(photos: Path, config: CalibrateConfig) -> dict[str, Any]:
    """Calibrate a folder of photos from scratch and return the figures."""
    with tempfile.TemporaryDirectory() as folder:
        report = calibrate(make_capture(photos, Path(folder) / "capture"), config)
        path = Path(folder) / "capture" / "cameras.json"
        figures: dict[str, Any] = {
            "photos": report.photos,
            "registered": report.photos_registered,
            "attempts": len(report.attempts),
            "worst_strong_pair": report.self_check.worst.consistent if report.self_check.worst else None,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest()[:16],
        }
        transforms = photos.parent / "transforms.json"
        if transforms.is_file():
            errors = center_errors(read_json(path, CamerasFile), json.loads(transforms.read_text(encoding="utf-8")))
            figures["center_error_percent_median"] = round(100.0 * float(np.median(errors)), 4)
            figures["center_error_percent_max"] = round(100.0 * float(errors.max()), 4)
    return figures


def main() -> int:
    """Print one JSON line a run; return 1 if a figure misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--max-features", type=int, default=CalibrateConfig().max_features)
    arguments = parser.parse_args()
    data = shared_data()
    if data is None:
        print("no measured data: set CGWM_SHARED_DATA", file=sys.stderr)
        return 2
    fox = data / "fox" / "images"
    store, features = Store("calibrate"), arguments.max_features
    good = True
    for seed in (int(value) for value in arguments.seeds.split(",")):
        config = CalibrateConfig(seed=seed, max_features=features)
        runs = [
            store.result(f"fox, {features} features, seed {seed}, run {turn}", lambda c=config: run_once(fox, c))
            for turn in (1, 2)
        ]
        good &= all(run["registered"] == run["photos"] == 50 for run in runs)
        good &= all(run["center_error_percent_median"] < 0.2 for run in runs)
        good &= runs[0]["sha256"] == runs[1]["sha256"]
    for name, folder in (("kermit", "images"), ("et", "et")):
        photos, config = data / "kermit" / folder, CalibrateConfig(max_features=features)
        run = store.result(f"{name}, {features} features, seed 0", lambda p=photos, c=config: run_once(p, c))
        good &= run["registered"] == run["photos"]
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
