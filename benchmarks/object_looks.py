"""How a fitted object looks in the test episodes of a built-in scene: PSNR at the predicted and at the true poses.

At predicted poses the errors of the motion count, too; at true poses those of shape, colours and light alone do. The
figure is that of `cgwm eval`: over the pixels of the predicted or the true mask, a mean over frames of all episodes and
cameras. Run with

    python benchmarks/object_looks.py DEMO [DEMO ...] [--model model] [--every 4]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.truth import TruthFile
from cgwm.pipeline.evaluate.image_errors import VideoErrors
from cgwm.pipeline.evaluate.prediction import MODEL, EpisodePrediction, Motion
from cgwm.pipeline.evaluate.stage import evaluate_model


def true_motion(prediction: EpisodePrediction, truth: TruthFile) -> Motion:
    """Return the true poses of the only body at the times of a prediction."""
    known = truth.episodes[prediction.episode]
    frame = np.abs(np.asarray(known.time_s)[:, None] - prediction.grid_s).argmin(0)
    assert np.abs(np.asarray(known.time_s)[frame] - prediction.grid_s).max() < 1e-3
    return Motion(np.asarray(known.position_m)[frame][:, None], np.asarray(known.quat_wxyz)[frame][:, None])


def looks(demo: Path, name: str, every: int) -> dict[str, Any]:
    """Return the figures of a demo's folder with a model of one free body."""
    model, truth = read_model(demo / name), read_truth(demo / "capture")
    capture = Capture.open(demo / "capture", splits=("test",))
    found = evaluate_model(model, capture, "test", 0.1, "cpu", brief=True)
    videos = VideoErrors(model=model, capture=capture, every=every)
    at: dict[str, list[float]] = {"predicted": [], "true": []}
    for episode in found.episodes:
        motions = {"predicted": episode.prediction.motions[MODEL], "true": true_motion(episode.prediction, truth)}
        for camera in truth.cameras.videos or {}:
            for kind, motion in motions.items():
                compared = videos.compare(replace(episode.prediction, motions={MODEL: motion}), camera)
                at[kind] += [] if compared is None else compared.psnr_object_db[MODEL].tolist()
    moved, turned = found.result.translation_error_m, found.result.rotation_error_deg
    assert moved is not None and turned is not None  # the test episodes have tracks
    return {
        "demo": str(demo),
        "scene": truth.scene,
        "seed": truth.seed,
        "frames": len(at["true"]),
        **{f"psnr_object_db_at_{kind}_poses": round(float(np.nanmean(values)), 2) for kind, values in at.items()},
        "translation_error_mm": round(1e3 * moved.median, 2),
        "rotation_error_deg": round(turned.median, 2),
    }


def main() -> None:
    """Print a JSON line for each demo."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demos", type=Path, nargs="+")
    parser.add_argument("--model", default="model")
    parser.add_argument("--every", type=int, default=4, help="stride of the frames")
    given = parser.parse_args()
    for demo in given.demos:
        print(json.dumps(looks(demo, given.model, given.every)), flush=True)


if __name__ == "__main__":
    main()
