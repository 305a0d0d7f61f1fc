"""How a fitted object looks in the test episodes of a built-in scene, and what its errors come from.

PSNR over the pixels of the rendered or the true mask, as `cgwm eval` has it, a mean over frames of all episodes and
cameras: the model at predicted and at true poses; the same under the true light; and the true scene itself, without
noise, at predicted poses (no model of the appearance does better there, however exact) and at true ones (noise alone).
The noise floor is the error of poses that the measurement of the start alone makes.
Shares are those of the square error of the model at true poses: where the object is missing, where it spills over its
outline, and inside, on sides that faced down in the photos (hidden) and on others; `share_inside_smooth` is what of the
inside remains if errors are averaged over some 10 px: shading and tint, not texture. Run with

    python benchmarks/object_looks.py DEMO [DEMO ...] [--model model] [--every 4] [--brief]
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import Model, read_model
from cgwm.datasets.synthetic import plan_scene, read_truth
from cgwm.datasets.synthetic.dynamics import matrix_from_quat, quat_from_matrix
from cgwm.datasets.synthetic.plan import EpisodePlan
from cgwm.datasets.synthetic.raycast import rays_through
from cgwm.datasets.synthetic.record import Set, _empty, _moments, build_set
from cgwm.datasets.synthetic.truth import TruthFile
from cgwm.pipeline.evaluate.image_errors import VideoErrors, _numbered
from cgwm.pipeline.evaluate.prediction import MODEL, EpisodePrediction, Motion
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.rendering.video_view import expose, video_view
from cgwm.schemas import Exposure, Light
from numpy.typing import NDArray

Array = NDArray[np.float64]
HIDDEN = -0.5
"""Vertical component of an outward normal in the photos below which a side was hidden there."""

SMOOTH_PX = 4.0
"""Standard deviation of the weights of an average [px]."""


def true_motion(prediction: EpisodePrediction, truth: TruthFile) -> Motion:
    """Return the true poses of the only body at the times of a prediction."""
    known = truth.episodes[prediction.episode]
    frame = np.abs(np.asarray(known.time_s)[:, None] - prediction.grid_s).argmin(0)
    assert np.abs(np.asarray(known.time_s)[frame] - prediction.grid_s).max() < 1e-3
    return Motion(np.asarray(known.position_m)[frame][:, None], np.asarray(known.quat_wxyz)[frame][:, None])


@dataclass
class TrueScene:
    """What is filmed, and its light in the form that models have."""

    filmed: Set

    @staticmethod
    def of(capture: Capture, truth: TruthFile) -> TrueScene:
        """Build the scene of a capture again."""
        cameras = truth.cameras.cameras
        sizes = [(cameras[name].width, cameras[name].height) for name in ("photos", "left")]
        return TrueScene(build_set(plan_scene(truth.scene, truth.seed), sizes[0], sizes[1], len(capture.photos())))

    @cached_property
    def stills(self) -> dict[str, NDArray[np.float32]]:
        """Return what each camera sees without the object."""
        return {name: _empty(self.filmed, camera) for name, camera in self.filmed.videos.items()}

    @property
    def light(self) -> Light:
        """Return the light as a model states it; the lamp is so far away that it has one direction."""
        lamp = self.filmed.lamp
        middle, half = (lamp.ambient + lamp.underneath) / 2, (lamp.ambient - lamp.underneath) / 2
        x, y, z = lamp.position / np.linalg.norm(lamp.position) * lamp.diffuse / middle
        return Light(lamp=(float(x), float(y), float(z)), sky=half / middle)

    def episode(self, name: str) -> EpisodePlan:
        """Return an episode."""
        return next(one for one in self.filmed.plan.episodes if one.name == name)

    def frame(self, camera: str, moments: Array) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return a frame without noise (H, W, 3), the mean over the moments of an exposure, and its mask (H, W)."""
        caster, view = self.filmed.caster, self.filmed.videos[camera]
        drawn = []
        for qpos in moments:
            caster.place(qpos)
            drawn.append(caster.render(view, None, self.filmed.samples))
        colors = np.mean([one.color for one in drawn], 0) * np.asarray(self.filmed.gains[camera], np.float32)
        return (colors.clip(0, 1) * 255 + 0.5).astype(np.uint8), drawn[len(drawn) // 2].label

    def hidden(self, camera: str, moments: Array) -> NDArray[np.uint8]:
        """Return 255 where a camera sees a side of the object that faced down in the photos, (H, W)."""
        view, caster = self.filmed.videos[camera], self.filmed.caster
        caster.place(moments[len(moments) // 2])
        x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
        ways, _ = rays_through(view, np.stack([x, y], -1).reshape(-1, 2).astype(float))
        hits = caster.cast(view.T_world_cam[:3, 3], ways)
        turned = matrix_from_quat(self.filmed.plan.photo_qpos[3:7]) @ matrix_from_quat(moments[1][3:7]).T
        down = (hits.normal @ turned.T)[:, 2] < HIDDEN
        return (255 * (down & (caster.label_of[hits.geom] > 0))).astype(np.uint8).reshape(view.height, view.width)


def moved(moments: Array, position: Array, quat: Array) -> Array:
    """Return the moments of an exposure of a body whose pose at the middle one is another."""
    middle = moments[len(moments) // 2]
    turn = matrix_from_quat(quat) @ matrix_from_quat(middle[3:7]).T
    found = moments.copy()
    found[:, :3] += position - middle[:3]
    for row in found:
        row[3:7] = quat_from_matrix(turn @ matrix_from_quat(row[3:7]))
    return found


def budget(videos: VideoErrors, scene: TrueScene, prediction: EpisodePrediction, camera: str, truth: TruthFile) -> Any:
    """Return PSNR by kind, and square errors by part, of the frames of an episode; None where none is compared."""
    footage = videos._footage(prediction, camera)
    if footage is None or footage.objects is None:
        return None
    predicted, true = prediction.motions[MODEL], true_motion(prediction, truth)
    at = np.abs(prediction.grid_s[:, None] - footage.time_s).argmin(0)
    exposure = videos.model.file.exposures.get(camera, Exposure())
    film, rate = scene.episode(prediction.episode), scene.filmed.plan.frame_rate
    lit = replace(videos, model=with_light(videos.model, scene.light), _renderers={})
    decibels: dict[str, list[float]] = {}
    drawn = {}
    for kind, errors, motion in (
        ("model_at_predicted", videos, predicted),
        ("model_at_true", videos, true),
        ("true_light_at_predicted", lit, predicted),
        ("true_light_at_true", lit, true),
    ):
        pictures, labels = errors._render(footage, camera, motion, at)
        drawn[kind] = expose(errors._blurred(footage, camera, motion, prediction.grid_s, pictures), exposure), labels
        decibels[kind] = videos._ratios(footage, drawn[kind][0], labels > 0)[1].tolist()
    frames = videos.capture.video_frames(camera, prediction.episode)
    parts: dict[str, float] = defaultdict(float)
    exact: dict[str, list[Any]] = {"truth_at_predicted": [], "truth_at_true": []}
    hidden = []
    for k, row in enumerate(at):
        number = round(float(footage.time_s[k]) * rate)
        view = video_view(videos.capture, camera, prediction.episode, number, frames.shape[2:0:-1])
        moments = _moments(film.motion, number / rate)
        for kind, motion in (("truth_at_predicted", predicted), ("truth_at_true", true)):
            shown, mask = scene.frame(camera, moved(moments, motion.position_m[row, 0], motion.quat_wxyz[row, 0]))
            exact[kind].append((view.undistorted(shown)[0], view.undistorted(mask, labels=True)[0]))
        hidden.append(view.undistorted(scene.hidden(camera, moments), labels=True)[0] > 0)
    for kind, pairs in exact.items():
        pictures = np.stack([one for one, _ in pairs]).astype(np.float32) / np.float32(255)
        labels = _numbered(np.stack([mask for _, mask in pairs]), [1])
        decibels[kind] = videos._ratios(footage, pictures, labels > 0)[1].tolist()
    shown, labels = drawn["model_at_true"]
    mine, its, under = labels > 0, footage.objects > 0, np.stack(hidden)
    off = shown - footage.images.astype(np.float32) / 255
    square = np.square(off).mean(-1) * footage.valid
    for error, where in zip(off, mine & its & footage.valid, strict=True):
        parts["inside_smooth"] += float(np.square(averaged(error, where))[where].mean(-1).sum())
    for name, where in {
        "missing": its & ~mine,
        "spilt": mine & ~its,
        "inside_hidden": mine & its & under,
        "inside_seen": mine & its & ~under,
    }.items():
        parts[name] += float(square[where].sum())
        parts[f"{name}_px"] += float(where.sum())
    return decibels, parts


def averaged(values: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Return values (H, W, 3) averaged over neighbours among chosen pixels (H, W), with Gaussian weights."""
    weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), SMOOTH_PX)[..., None]
    return np.asarray(cv2.GaussianBlur(values * where[..., None], (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6))


def with_light(model: Model, light: Light) -> Model:
    """Return a model under another light."""
    return replace(model, file=model.file.model_copy(update={"light": light}))


def looks(demo: Path, name: str, every: int, brief: bool) -> dict[str, Any]:
    """Return the figures of a demo's folder with a model of one free body."""
    model, truth = read_model(demo / name), read_truth(demo / "capture")
    capture = Capture.open(demo / "capture", splits=("test",))
    found = evaluate_model(model, capture, "test", 0.1, "cpu", brief=True)
    videos = VideoErrors(model=model, capture=capture, every=every)
    at: dict[str, list[float]] = defaultdict(list)
    parts: dict[str, float] = defaultdict(float)
    scene = None if brief else TrueScene.of(capture, truth)
    for episode in found.episodes:
        for camera in truth.cameras.videos or {}:
            if scene is not None:
                both = budget(videos, scene, episode.prediction, camera, truth)
                for kind, values in (both or ({}, {}))[0].items():
                    at[kind] += values
                for part, value in (both or ({}, {}))[1].items():
                    parts[part] += value
                continue
            motions = {
                "predicted": episode.prediction.motions[MODEL],
                "true": true_motion(episode.prediction, truth),
            }
            for kind, motion in motions.items():
                compared = videos.compare(replace(episode.prediction, motions={MODEL: motion}), camera)
                at[f"model_at_{kind}"] += [] if compared is None else compared.psnr_object_db[MODEL].tolist()
    moved_m, turned = found.result.translation_error_m, found.result.rotation_error_deg
    assert moved_m is not None and turned is not None  # the test episodes have tracks
    whole = sum(parts.get(part, 0.0) for part in ("missing", "spilt", "inside_hidden", "inside_seen")) or 1.0
    return {
        "demo": str(demo),
        "scene": truth.scene,
        "seed": truth.seed,
        "frames": len(at["model_at_true"]),
        **{f"psnr_object_db_{kind}_poses": round(float(np.nanmean(values)), 2) for kind, values in at.items()},
        **{f"share_{part}": round(value / whole, 3) for part, value in parts.items() if not part.endswith("_px")},
        **{part: round(value) for part, value in parts.items() if part.endswith("_px")},
        "translation_error_mm": round(1e3 * moved_m.median, 2),
        "rotation_error_deg": round(turned.median, 2),
        "noise_floor_mm": round(float(np.median([1e3 * one.prediction.noise_floor_m for one in found.episodes])), 2),
    }


def main() -> None:
    """Print a JSON line for each demo."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demos", type=Path, nargs="+")
    parser.add_argument("--model", default="model")
    parser.add_argument("--every", type=int, default=4, help="stride of the frames")
    parser.add_argument("--brief", action="store_true", help="the model at predicted and true poses alone")
    given = parser.parse_args()
    for demo in given.demos:
        print(json.dumps(looks(demo, given.model, given.every, given.brief)), flush=True)


if __name__ == "__main__":
    main()
