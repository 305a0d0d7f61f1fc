"""What a shadow that a moving body does not cast costs, in decibels.

python benchmarks/shadows.py [--seeds N] [--frames N]

The frames of the built-in scenes fall and push, ray cast twice: as they are, and with a ground that no body shades. The
PSNR of one against the other is what a model could reach at most that is right in everything but the cast shadow:
over the whole frame, and over the shadow alone (pixels of the ground that differ).
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.record import Set, _empty, build_set, frame_of
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=5, help="of each camera and episode")
    options = parser.parse_args()
    store = Store("shadows")
    for name in ("fall", "push"):
        store.add(name, measure(name, options.seeds, options.frames))


if __name__ == "__main__":
    main()
