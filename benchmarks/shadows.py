"""What the shadow of a moving body is worth, in decibels: where it is missing, and as a fitted model draws it.

python benchmarks/shadows.py [--seeds N] [--frames N]
python benchmarks/shadows.py --model MODEL [--scene fall] [--seed 0] [--frames N]

Without a model: the frames of the built-in scenes fall and push, ray cast twice: as they are, and with a ground that no
body shades. The PSNR of one against the other is what a model could reach at most that is right in everything but the
cast shadow: over the whole frame, and over the shadow alone (pixels of the ground that differ).

With a model that was fitted to a built-in scene: its pictures of the test episodes' true poses, with and without
`synthesize.shadows`, against the ray-cast frames, whose brightness is fitted to the model's by one factor a channel.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import time_ns
from typing import Any

import numpy as np
from cgwm.datasets.models.model import Model, read_model
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.dynamics import matrix_from_quat, quat_from_matrix
from cgwm.datasets.synthetic.record import Set, _empty, build_set, frame_of
from cgwm.pipeline.rendering.ground_shadow import shadow_of
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from store import Store

GROUND_M = 1e-4
"""Points up to this height are the ground's, or touch it."""


def unshaded(scene: Set) -> None:
    """Let the lamp reach all of the ground."""
    caster, light = scene.caster, scene.caster._light

    def lit_ground(points: Any, normals: Any, facing_only: bool) -> Any:
        values, lit = light(points, normals, facing_only)
        shaded = ~lit & (points[:, 2] < GROUND_M)
        to_lamp = caster.lamp.position - points[shaded]
        cosine = (to_lamp * normals[shaded]).sum(1) / np.linalg.norm(to_lamp, axis=1)
        values[shaded] += caster.lamp.diffuse * cosine.clip(0, 1)
        lit[shaded] = True
        return values, lit

    caster._light = lit_ground


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Return the PSNR [dB] of colours in [0, 1]; at most 60."""
    return float(-10 * np.log10(max(np.square(first - second).mean(), 1e-6)))


def measure(name: str, seeds: int, frames: int) -> dict[str, Any]:
    """Return medians over frames of all cameras, episodes and seeds."""
    whole, inside, share = [], [], []
    for seed in range(seeds):
        plan = plan_scene(name, seed)
        scenes = [build_set(plan, (64, 48), (320, 240), 3) for _ in range(2)]
        unshaded(scenes[1])
        for camera in scenes[0].videos.values():
            empty = _empty(scenes[0], camera)
            for episode in plan.episodes[:2]:
                for frame in np.linspace(0, episode.frame_count - 1, frames).astype(int):
                    time = frame / plan.frame_rate
                    (truth, label), (flat, _) = (frame_of(s, camera, episode.motion, time, empty) for s in scenes)
                    cast = (np.abs(truth - flat).max(-1) > 1 / 255) & (label == 0)
                    whole.append(psnr(truth, flat))
                    if cast.sum() > 20:
                        share.append(cast.mean())
                        inside.append(psnr(truth[cast], flat[cast]))
    return {
        "frames": len(whole),
        "whole_frame_db": float(np.median(whole)),
        "whole_frame_db_lowest": float(np.min(whole)),
        "in_the_shadow_db": float(np.median(inside)),
        "shadow_share_of_frame": float(np.median(share)),
    }


def poses_of(model: Model, photo_qpos: np.ndarray, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (T, B, 3) [m] and quaternions (T, B, 4) of a model's bodies where the true object is at `qpos`.

    The model's body lies in the photos where the true one does.
    """
    pose = model.file.bodies[0].photo_pose
    turn = matrix_from_quat(photo_qpos[3:]).T @ matrix_from_quat(np.array(pose.quat_wxyz))
    shift = matrix_from_quat(photo_qpos[3:]).T @ (np.array(pose.position_m) - photo_qpos[:3])
    turns = [matrix_from_quat(row[3:7]) for row in qpos]
    position = np.stack([row[:3] + R @ shift for row, R in zip(qpos, turns, strict=True)])
    return position[:, None], np.stack([quat_from_matrix(R @ turn) for R in turns])[:, None]


def scores(picture: np.ndarray, truth: np.ndarray, flat: np.ndarray, label: np.ndarray) -> tuple[float, float | None]:
    """Return the PSNR [dB] of a picture in the frame, and in the shadow on the ground; None without one."""
    shaded = np.abs(truth - flat).max(-1) > 1 / 255
    ground, lit = label == 0, (label == 0) & ~shaded
    even = picture * (truth[lit].sum(0) / picture[lit].sum(0))
    cast = shaded & ground
    return psnr(truth, even), psnr(truth[cast], even[cast]) if cast.sum() > 20 else None


def measure_model(path: Path, name: str, seed: int, frames: int) -> dict[str, Any]:
    """Return medians over frames of all cameras and test episodes of a scene."""
    model, plan = read_model(path), plan_scene(name, seed)
    shaded, flat = (build_set(plan, (64, 48), (320, 240), 3) for _ in range(2))
    unshaded(flat)
    kinds = {"without": None, "with": shadow_of(model.file)}
    found: dict[str, list[tuple[float, float | None]]] = {kind: [] for kind in kinds}
    seconds = dict.fromkeys(kinds, 0.0)
    films = [(key, film, one) for key, film in shaded.videos.items() for one in plan.episodes if one.split == "test"]
    for key, film, episode in films:
        camera = replace(film, distortion=np.zeros(0))
        empty, times = _empty(shaded, camera), np.linspace(0, episode.frame_count - 1, frames).astype(int)
        drawn = [
            [frame_of(scene, camera, episode.motion, time, empty) for time in times / plan.frame_rate]
            for scene in (shaded, flat)
        ]
        qpos = episode.motion.qpos[[episode.motion.row(time) for time in times / plan.frame_rate]]
        for kind, shadow in kinds.items():
            renderer = LabelRenderer(model, {key: camera}, shadow=shadow)
            begun = time_ns()
            blocks = list(renderer.blocks(*poses_of(model, plan.photo_qpos, qpos[:, :7])))
            seconds[kind] += (time_ns() - begun) / 1e9
            pictures = np.concatenate([block.image for block in blocks]) / 255
            found[kind] += [
                scores(picture, truth, plain, label)
                for picture, (truth, label), (plain, _) in zip(pictures, *drawn, strict=True)
            ]
    inside = {kind: np.array([one[1] for one in some if one[1] is not None]) for kind, some in found.items()}
    return {
        "frames": len(found["with"]),
        **{f"whole_frame_{kind}_db": float(np.median([one[0] for one in some])) for kind, some in found.items()},
        **{f"in_the_shadow_{kind}_db": float(np.median(some)) for kind, some in inside.items()},
        "better_frames": int((inside["with"] > inside["without"]).sum()),
        "frames_with_a_shadow": len(inside["with"]),
        **{f"ms_a_frame_{kind}": 1e3 * spent / len(found[kind]) for kind, spent in seconds.items()},
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=5, help="of each camera and episode")
    parser.add_argument("--model", type=Path, help="fitted to a built-in scene")
    parser.add_argument("--scene", default="fall", choices=("fall", "push"), help="of the model")
    parser.add_argument("--seed", type=int, default=0, help="of the model's scene")
    options = parser.parse_args()
    store = Store("shadows")
    if options.model is not None:
        found = measure_model(options.model, options.scene, options.seed, options.frames)
        store.add(f"model of {options.scene} {options.seed}", found)
        return
    for name in ("fall", "push"):
        store.add(name, measure(name, options.seeds, options.frames))


if __name__ == "__main__":
    main()
