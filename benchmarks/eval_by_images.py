"""What `cgwm eval` finds out from films alone, beside the truth: errors of predictions, and whether intervals hold.

    python benchmarks/eval_by_images.py run --seed 800 --device cuda --workers 8 --seconds 500
    python benchmarks/eval_by_images.py table

A capture of the benchmark `fall_push.py` is filmed in full, a model is fitted to its photos and to one video of 15
frames, and its two other films (60 frames, two cameras, masks) are evaluated by images. Every second capture has the
cameras that `cgwm calibrate` finds in its photos, the others the true ones. Captures come in an order that the seed
draws, each with a seed of its own.

A pose that is turned by more than 45 deg in the first frame was taken for another that looks alike: errors of rotation
are then counted from it, as the prediction begins with it, too. The world of calibrated cameras lies a little
otherwise than the true one: true errors are counted after predictions are brought into the true world by the centres
of the photos; the scale's error stays in what is found.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic import TruthFile, read_truth
from cgwm.pipeline.calibrate import calibrate
from cgwm.pipeline.evaluate.evaluation import EpisodeEvaluation
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.fit import fit
from cgwm.schemas import CalibrateConfig, CgwmError, InputDataError, PhysConfig, SplatConfig
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from store import Store
from tabletop import MATERIALS, make_capture
from tabletop.capture import TASKS
from tabletop.engines import refusal
from tabletop.jobs import CaptureJob
from tabletop.objects import load_item

Array = NDArray[np.float64]
OBJECTS = ("box", "l_block", "mustard_bottle", "mug")
ENGINES = ("rapier", "dart", "mujoco")
TESTS = 2
ALIKE_DEG = 45.0
_KINDS = (("true cameras", False), ("calibrated cameras", True))


@dataclass(frozen=True)
class Job(CaptureJob):
    """One capture, and which cameras it has."""

    calibrated: bool


def drawn(seed: int) -> list[Job]:
    """Return every task, object and engine once, in an order that a seed draws, with grounds drawn, too."""
    rng = np.random.default_rng(seed)
    kinds = [(t, o, e) for t in TASKS for o in OBJECTS for e in ENGINES if (t, o) != ("tip", "mug")]
    kinds = [kinds[k] for k in rng.permutation(len(kinds))]
    able = {(o, e): refusal(e, load_item(o).solid) is None for o in OBJECTS for e in ENGINES}
    grounds = list(MATERIALS)
    return [
        Job(task, obj, grounds[int(rng.integers(len(grounds)))], engine, seed + k, k % 2 == 0)
        for k, (task, obj, engine) in enumerate(one for one in kinds if able[one[1:]])
    ]


def measure(job: Job, folder: Path, device: str) -> dict[str, Any]:
    """Make a capture, fit a model, evaluate it by images, and return its episodes' errors beside the true ones."""
    root = folder / job.key.replace("/", "_")
    frame = Frame()
    try:
        make_capture(root, job.object, job.material, job.task, job.seed, TESTS, engine=job.engine)
        if job.calibrated:
            true = _photo_centers(root)
            (root / "cameras.json").unlink()
            calibrate(root, CalibrateConfig(seed=job.seed))
            frame = Frame.between(true, _photo_centers(root))
        splats = SplatConfig(seed=job.seed, device=device)  # pyright: ignore[reportArgumentType]
        physics = PhysConfig(supervise="images", seed=job.seed, device=device)  # pyright: ignore[reportArgumentType]
        fit(root, root / "scene", stage="sg-gs", splat_config=splats)
        fit(root, root / "model", stage="phys-geo", parent=root / "scene", phys_config=physics)
        found = evaluate_model(
            read_model(root / "model"), Capture.open(root, splits=("test",)), device=device, reference="images"
        )
        rows = [episode_row(one, read_truth(root), frame) for one in found.episodes]
    except CgwmError as error:
        return vars(job) | {"failed": error.found}
    finally:
        shutil.rmtree(root, ignore_errors=True)
    return vars(job) | {"frame": frame.record(), "episodes": rows, "warnings": list(found.result.warnings)}


@dataclass(frozen=True, eq=False)
class Frame:
    """Where the true world lies in that of the calibrated cameras: x_calibrated = scale * turn @ x_true + shift [m]."""

    scale: float = 1.0
    turn: Rotation = field(default_factory=Rotation.identity)
    shift_m: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def between(true_m: dict[str, Array], found_m: dict[str, Array]) -> Frame:
        """Return the similarity that takes the true centres of photos to those found, by least squares."""
        both = [name for name in found_m if name in true_m]
        true, found = (np.stack([centers[name] for name in both]) for centers in (true_m, found_m))
        arms, reached = true - true.mean(0), found - found.mean(0)
        turn = Rotation.align_vectors(reached, arms)[0]
        scale = float((reached * turn.apply(arms)).sum() / np.square(arms).sum())
        return Frame(scale, turn, found.mean(0) - scale * turn.apply(true.mean(0)))

    def to_true(self, position_m: Array, turn: Rotation) -> tuple[Array, Rotation]:
        """Return positions (F, 3) [m] and rotations of the calibrated cameras' world in the true one."""
        return self.turn.inv().apply(position_m - self.shift_m) / self.scale, self.turn.inv() * turn

    def record(self) -> dict[str, float]:
        """Return how large it is."""
        shift, turn = float(1e3 * np.linalg.norm(self.shift_m)), float(np.degrees(self.turn.magnitude()))
        return {"scale": round(self.scale, 5), "shift_mm": round(shift, 2), "turn_deg": round(turn, 3)}


def _photo_centers(root: Path) -> dict[str, Array]:
    """Return the centres of a capture's registered photos [m]."""
    capture, centers = Capture.open(root), dict[str, Array]()
    for name in capture.photos():
        with contextlib.suppress(InputDataError):  # not registered
            centers[name] = np.asarray(np.linalg.inv(capture.photo_camera(name).T_cam_world)[:3, 3], float)
    return centers


def episode_row(one: EpisodeEvaluation, truth: TruthFile, frame: Frame) -> dict[str, Any]:
    """Return the estimates of an episode and the true values of the same means, with predictions in the true world."""
    prediction, errors, motion = one.prediction, one.errors, truth.episodes[one.prediction.episode]
    rows = np.abs(np.asarray(motion.time_s)[:, None] - prediction.time_s).argmin(0)
    place, turn = np.asarray(motion.position_m)[rows], _rotation(np.asarray(motion.quat_wxyz)[rows])
    found, after = prediction.predicted(), ~prediction.warmup
    predicted, turned = frame.to_true(found[0][:, 0], _rotation(found[1][:, 0]))
    tracked_m, tracked_turn = frame.to_true(prediction.position_m[:, 0], _rotation(prediction.quat_wxyz[:, 0]))
    alike = turn[0].inv() * tracked_turn[0]
    if np.degrees(alike.magnitude()) < ALIKE_DEG:
        alike = Rotation.identity()
    com = np.asarray(truth.object.com_m)
    middles = predicted + turned.apply(alike.inv().apply(com)) - place - turn.apply(com)
    tracked = tracked_m - place
    return {
        "episode": errors.episode,
        "true_m": _mean(predicted - place, after),
        "found_m": errors.translation_error_m,
        "interval_m": errors.translation_interval_95_m,
        "true_deg": float(np.degrees(((turn * alike).inv() * turned).magnitude())[after].mean()),
        "found_deg": errors.rotation_error_deg,
        "interval_deg": errors.rotation_interval_95_deg,
        "true_middle_m": _mean(middles, after),
        "found_middle_m": errors.centroid_error_m,
        "interval_middle_m": errors.centroid_interval_95_m,
        "poses_off_m": _mean(tracked, after),
        "alike_deg": float(np.degrees(alike.magnitude())),
        "mask_iou": errors.mask_iou,
    }


def _rotation(quat_wxyz: Any) -> Rotation:
    return Rotation.from_quat(np.roll(quat_wxyz, -1, -1))


def _mean(shifts: Any, after: Any) -> float:
    return float(np.linalg.norm(shifts[after], axis=-1).mean())


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return how far the estimates are from the true means, and how many intervals hold these, in Markdown."""
    lines = ["| cameras | captures, episodes | mean error | median, 90 % off by | intervals that hold |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for words, calibrated in _KINDS:
        chosen = [row for row in rows if row["calibrated"] == calibrated and "episodes" in row]
        episodes = [one for row in chosen for one in row["episodes"]]
        for name, key, unit, scale in (
            ("position", "m", "mm", 1e3),
            ("rotation", "deg", "deg", 1.0),
            ("middle, by masks alone", "middle_m", "mm", 1e3),
        ):
            known = [one for one in episodes if one[f"found_{key}"] is not None]
            if known:
                off = [scale * abs(one[f"found_{key}"] - one[f"true_{key}"]) for one in known]
                hold = sum(_holds(one[f"interval_{key}"], one[f"true_{key}"]) for one in known)
                middle, high = np.percentile(off, (50, 90))
                figures = f"{middle:.2f}, {high:.2f} {unit} | {hold} of {len(known)}"
                lines.append(f"| {words} | {len(chosen)}, {len(known)} | {name} | {figures} |")
    failed = [f"- {row['key']}: {row['failed']}" for row in rows if "failed" in row]
    return "\n".join([*lines, *(["", "Failed:", *failed] if failed else [])])


def _holds(interval: Sequence[float], true: float) -> bool:
    return interval[0] <= true <= interval[1]


def main() -> int:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("--seed", type=int, default=800)
    parser.add_argument("--cameras", choices=("both", "true", "calibrated"), default="both", help="captures to take")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--seconds", type=float, help="begin none after this time")
    parser.add_argument("--folder", type=Path, default=Path("out") / "eval_by_images", help="captures and models")
    parser.add_argument("--store", type=Path, default=None, help="file of the results, JSON lines")
    parser.add_argument("--any-commit", action="store_true", help="take up results of other commits, too")
    given = parser.parse_args()
    store = Store("eval_by_images", given.store, given.any_commit)
    if given.what == "run":
        given.folder.mkdir(parents=True, exist_ok=True)
        folder = given.folder.resolve()
        jobs = [job for job in drawn(given.seed) if given.cameras in ("both", _KINDS[job.calibrated][0].split()[0])]
        arguments = {job.key: (job, folder, given.device) for job in jobs}
        store.fill(measure, arguments, given.workers, given.seconds)
    print(table(store.results()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
