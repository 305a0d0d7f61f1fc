"""Masks of `cgwm mask` beside true ones, on photos of one object whose surface is known (`object_photos`).

Each set is cut without a box, where it tells the body by itself, and from a box about the body in the first photo. Run
with

    python benchmarks/masks.py YCB [--objects mug] [--seeds 5] [--looks black-turntable,clutter-hand]

where YCB is the folder of the scans, `ycb/ycb` of `ycb.tar.xz`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from calibrate_objects import LOOKS, OBJECTS, sessions
from cgwm.datasets.capture.images import read_label
from cgwm.pipeline.mask import mask
from cgwm.schemas import InputDataError
from mesh_photos import scanned
from numpy.typing import NDArray
from object_photos import Session, photograph, write_photos
from store import Store

_MARGIN_PX = 8
_BAD = 0.8
"""IoU below which a mask is called bad."""


def figures(
    photos: Path, truth: list[NDArray[np.uint8]], box: tuple[float, float, float, float] | None
) -> dict[str, Any]:
    """Return the IoU of the masks of a folder of photos with the true ones (H, W), and how many bad ones were named."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            report = mask(photos, Path(folder) / "masks", box)
        except InputDataError as error:
            return {"refused": str(error).splitlines()[0].partition(": ")[2]}
        found = [read_label((Path(folder) / "masks" / name).with_suffix(".png")) > 0 for name in report.photos]
        doubtful = [name in report.doubtful for name in report.photos]
    iou = np.array([(a & (b > 0)).sum() / max((a | (b > 0)).sum(), 1) for a, b in zip(found, truth, strict=True)])
    bad = iou < _BAD
    return {
        "method": report.method,
        "iou_mean": round(float(iou.mean()), 3),
        "iou_least": round(float(iou.min()), 3),
        "bad": int(bad.sum()),
        "bad_named": int((bad & doubtful).sum()),
        "named": sum(doubtful),
    }


def measured(ycb: Path, name: str, session: Session) -> dict[str, Any]:
    """Photograph an object, and cut it out without and with a box."""
    photos, truth = photograph(scanned(ycb / name), session)
    rows, columns = np.nonzero(truth[0])
    height, width = truth[0].shape
    low, high = (max(0, int(one.min()) - _MARGIN_PX) for one in (rows, columns)), (rows.max(), columns.max())
    upper, left = low
    box = (left, upper, min(int(high[1]) + _MARGIN_PX, width), min(int(high[0]) + _MARGIN_PX, height))
    with tempfile.TemporaryDirectory() as folder:
        write_photos(Path(folder) / "photos", photos)
        return {
            "alone": figures(Path(folder) / "photos", truth, None),
            "box": figures(Path(folder) / "photos", truth, box),
        }


def main() -> int:
    """Print one JSON line a set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ycb", type=Path)
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--seeds", default="5")
    parser.add_argument("--looks", default=",".join(f"{background}-{motion}" for background, motion, *_ in LOOKS))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    wanted = {
        f"{name} {session.background} {session.motion} {seed}": (arguments.ycb, name, session)
        for seed in arguments.seeds.split(",")
        for name in arguments.objects.split(",")
        for session in sessions(int(seed))
        if f"{session.background}-{session.motion}" in arguments.looks.split(",")
    }
    Store("masks", any_commit=True).fill(measured, wanted, arguments.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
