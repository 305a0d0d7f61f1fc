"""The pushes of PIN-WM: fitted to the masks of 12 frames from one camera, predicted for the other 20 and another push.

    python benchmarks/pinwm.py --work out/pinwm ../shared/data/pinwm
    python benchmarks/pinwm.py --work out/pinwm --set phys-geo.step_s=0.002 ../shared/data/pinwm

It is `cgwm import pinwm`, `cgwm fit --stage phys-geo --supervise images` and `cgwm eval`, and then a table: errors of
position [mm] and orientation [deg] over frames 12 to 31 of the push that was fitted and over all frames after the
warm-up of the one that was not, for the model and a block that stays where the warm-up left it (frozen), and that goes
on as it was (ballistic). The predictions start from the poses of the warm-up, the first four frames. What the import
assumes of the pusher, which is in no picture, stands in `datasets/importers/pinwm.py`; nothing was chosen on frames
12 to 31.
Published for PIN-WM on its own pushes: friction within 2 to 6 %, one-step errors of 17 mm in the object's frame.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from cgwm.cli.settings import StageSettings
from cgwm.datasets import Capture, import_pinwm, read_model
from cgwm.pipeline.evaluate.prediction import BALLISTIC, FROZEN, MODEL, EpisodePrediction
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.fit import fit
from cgwm.schemas import PhysConfig, SplatConfig

FIRST_PREDICTED = 12


def main() -> None:
    """Print one row for each push and method, and write all figures to `<work>/pinwm.json`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.NAME=VALUE")
    parser.add_argument("--refit", action="store_true", help="fit again, though there is a model")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    capture, model = arguments.work / "capture", arguments.work / "model"
    import_pinwm(arguments.source, capture, FIRST_PREDICTED, overwrite=True)
    seconds = None
    if arguments.refit or not model.exists():
        settings = StageSettings({"sg-gs": SplatConfig, "phys-geo": PhysConfig}, None, arguments.set)
        physics = settings.configure("phys-geo", PhysConfig).model_copy(update={"supervise": "images"})
        started = time.perf_counter()
        splats = settings.configure("sg-gs", SplatConfig)
        fit(capture, model, "phys-geo", splat_config=splats, phys_config=physics, overwrite=True)
        seconds = round(time.perf_counter() - started, 1)
    loaded = read_model(model)
    found = {p.name: (p.estimate, p.interval_95, p.state) for p in loaded.file.parameters}
    print(f"friction {found['friction'][0]:.4f} {found['friction'][1]}; fitted in {seconds} s")
    rows = []
    for episode in evaluate_model(loaded, Capture.open(capture), "test", brief=True).episodes:
        prediction = episode.prediction
        filmed = f"{prediction.episode}-first" in Capture.open(capture).manifest.splits["train"]
        chosen = ~prediction.warmup
        if filmed:
            chosen &= np.arange(len(chosen)) >= FIRST_PREDICTED
        for method in (MODEL, FROZEN, BALLISTIC):
            errors = _errors(prediction, method, chosen)
            rows.append({"push": prediction.episode, "fitted": filmed, "method": method, **errors})
    for row in rows:
        print(
            f"{row['push']:12s} {'frames 12-31' if row['fitted'] else 'unseen push':12s} {row['method']:9s} "
            f"{row['translation_mm']:7.2f} mm {row['rotation_deg']:6.2f} deg   "
            f"at the end {row['final_mm']:7.2f} mm {row['final_deg']:6.2f} deg"
        )
    result = {"rows": rows, "parameters": found, "fit_seconds": seconds, "warnings": loaded.file.warnings}
    (arguments.work / "pinwm.json").write_text(json.dumps(result, indent=1) + "\n")


def _errors(prediction: EpisodePrediction, method: str, chosen: np.ndarray) -> dict[str, float]:
    """Return mean and last errors over the chosen frames (T,)."""
    shift = 1e3 * prediction.translation_error_m(method)[chosen, 0]
    turn = prediction.rotation_error_deg(method)[chosen, 0]
    return {
        "translation_mm": float(shift.mean()),
        "rotation_deg": float(turn.mean()),
        "final_mm": float(shift[-1]),
        "final_deg": float(turn[-1]),
    }


if __name__ == "__main__":
    main()
