"""What remains of an object in the background where it stood in the photos, in decibels.

python benchmarks/ghost.py [--seeds 2,3] [--photos 40]

The built-in scene fall is photographed with its object at rest, from known cameras, and ray cast again without it from
the same cameras. The background of a model, without its bodies, is compared with the empty scene in the photos that no
fit has seen (every eighth): behind the object, in its shadow, and elsewhere, with `sg-gs.bare_ground` and without.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets import Capture, read_model, write_manifest
from cgwm.datasets.synthetic import plan_scene
from cgwm.datasets.synthetic.record import Set, _cameras_file, _empty, build_set, manifest, take_photos
from cgwm.datasets.synthetic.sensor import expose
from cgwm.pipeline.fit import fit
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.sg_gs.photos.views import load_views, render_view
from cgwm.schemas import SplatConfig
from store import Store

SIZE = (480, 360)
SHADED = 0.03
"""Least difference of a colour with and without the object, for a pixel of its shadow."""


def capture_of(scene: Set, root: Path) -> None:
    """Write photos, masks and true cameras of a scene."""
    root.mkdir()
    take_photos(scene, root)
    write_manifest(root / "capture.toml", manifest(scene).model_copy(update={"splits": {}}))
    cameras = _cameras_file(scene).model_copy(update={"videos": {}})  # there are none of the motion
    (root / "cameras.json").write_text(cameras.model_dump_json() + "\n", encoding="utf-8")


def empty_photo(scene: Set, name: str) -> np.ndarray:
    """Return a photo without the object, (H, W, 3) in [0, 1], with the gain of the photos."""
    colors = _empty(scene, scene.photos[name])
    return expose(colors, scene.gains["photos"], np.random.default_rng(0)).astype(np.float32) / 255


def psnr(errors: list[np.ndarray]) -> float:
    """Return the PSNR [dB] of errors (pixel, 3) of several photos."""
    return round(float(-10 * np.log10(np.square(np.concatenate(errors), dtype=float).mean())), 2)


@torch.no_grad()
def measured(model: Path, root: Path, scene: Set) -> dict[str, float]:
    """Return PSNR [dB] behind the object, in its shadow and elsewhere."""
    capture, background = Capture.open(root), read_model(model).scene
    assert background is not None  # the photos show one
    spheres, config = Spheres.from_numpy(background), SplatConfig()
    parts: dict[str, list[np.ndarray]] = {"behind": [], "shadow": [], "elsewhere": []}
    for view in load_views(capture, capture.photos()[:: config.test_every], config.image_size, torch.device("cpu")):
        original = capture.photo_camera(view.name)
        photo = (255 * empty_photo(scene, view.name) + 0.5).astype(np.uint8)
        straight, camera = original.undistorted(photo)
        truth = _resized(straight.astype(np.float32) / 255, view.size)
        picture = render_view(spheres, view).features[0][..., :3].clamp(0, 1).numpy()
        assert view.cover is not None and camera.width == view.camera.width
        behind = view.cover[0].numpy() > 0.5
        shadow = (np.abs(view.image.numpy() - truth).max(-1) > SHADED) & (view.cover[0].numpy() == 0)
        for name, where in (("behind", behind), ("shadow", shadow), ("elsewhere", ~behind & ~shadow)):
            parts[name].append((picture - truth)[where])
    return {f"{name}_db": psnr(errors) for name, errors in parts.items()}


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def measure(seed: int, photos: int) -> dict[str, Any]:
    """Fit one scene with and without bare ground, and return the figures of both."""
    scene = build_set(plan_scene("fall", seed), SIZE, (64, 48), photos)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "capture"
        capture_of(scene, root)
        for name, bare in (("as photographed", False), ("bare", True)):
            model = Path(folder) / f"model-{bare}"
            config = SplatConfig(device="cpu", bare_ground=bare, turntable=False, seed=seed)
            fit(root, model, stage="sg-gs", splat_config=config)
            found[name] = measured(model, root, scene)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="2,3")
    parser.add_argument("--photos", type=int, default=40)
    options = parser.parse_args()
    store = Store("ghost")
    for seed in map(int, options.seeds.split(",")):
        store.result(f"fall {seed} {options.photos}", lambda s=seed: measure(s, options.photos))


if __name__ == "__main__":
    main()
