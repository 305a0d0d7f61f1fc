"""Bodies separated without masks: the masks found in the built-in falls against the true ones.

python benchmarks/separation.py [--seeds 0,1,2,4]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.record import build_set, manifest, take_photos, truth
from cgwm.pipeline.sg_gs.photos.views import View, load_views
from cgwm.pipeline.sg_gs.separation.body_separation import separate
from cgwm.schemas import PhotoBox, SplatConfig
from store import Store

BOX = PhotoBox(min_m=(-0.11, -0.12, -0.005), max_m=(0.11, 0.12, 0.12))
"""About 3 cm of air beside the objects and above them, and a little of the mat."""
WANTED = {"box": 0.95, "ground": 0.93}


def photograph(seed: int, root: Path) -> Capture:
    """Take the 48 photos of the demo, with its true cameras and masks."""
    scene = build_set(plan_scene("fall", seed), (640, 480), (16, 16), 48)
    take_photos(scene, root)
    write_manifest(root / "capture.toml", manifest(scene))
    (root / "cameras.json").write_text(truth(scene).cameras.model_dump_json())
    return Capture.open(root, check=False)


def measure(capture: Capture, method: str) -> dict[str, Any]:
    """Separate the body by one method, every eighth photo held out; compare the masks with the true ones."""
    (body,) = capture.manifest.bodies
    body = body.model_copy(update={"photo_box": BOX if method == "box" else None})
    capture = replace(capture, manifest=capture.manifest.model_copy(update={"bodies": (body,)}))
    views = load_views(capture, capture.photos(), 320, torch.device("cpu"))
    bare = [replace(view, labels=None, cover=None) for view in views]
    train = [view for number, view in enumerate(bare) if number % 8]
    started = time.perf_counter()
    found = separate(capture, train, bare[::8], capture.manifest.world.ground, None, SplatConfig(device="cpu"))
    assert found is not None
    seconds = time.perf_counter() - started
    true = {view.name: view for view in views}
    fitted, held_out = ([_iou(view, true[view.name]) for view in part] for part in (found.train, found.test))
    return {
        "mean_iou": round(float(np.mean(fitted)), 4),
        "least_iou": round(min(fitted), 4),
        "mean_iou_held_out": round(float(np.mean(held_out)), 4),
        "wanted": WANTED[method],
        "seconds": round(seconds, 1),
        **found.record[body.name],
    }


def _iou(view: View, true: View) -> float:
    assert view.labels is not None and true.labels is not None
    mine, wanted = view.labels == 1, true.labels == 1
    return float((mine & wanted).sum() / (mine | wanted).sum())


def main() -> int:
    """Print one JSON line for each seed and method; return 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2,4")
    store, met = Store("separation"), []
    for seed in parser.parse_args().seeds.split(","):
        with tempfile.TemporaryDirectory() as folder:
            capture = photograph(int(seed), Path(folder))
            for method in WANTED:
                row = store.result(f"seed {seed}, {method}", lambda one=capture, how=method: measure(one, how))
                met.append(row["mean_iou"] >= row["wanted"])
    print(f"{sum(met)} of {len(met)} targets met")
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
