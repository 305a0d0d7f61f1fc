"""What colours that depend on the direction of view give and cost, on photos of a glossy object with known cameras.

python benchmarks/gloss.py YCB [--object mustard_bottle] [--gloss 0.4]

A scanned object under a lamp is photographed from all around before a white background, and fitted with
`sg-gs.gloss`. Photos that the fit has not seen are compared with the model and with the same without the harmonics:
as the object stood, and with the lamp turned about it, which is the object turned under the lamp. YCB is the folder of
the scans, `ycb/ycb` of `ycb.tar.xz`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from cgwm.datasets import Camera, Capture, read_model, write_image
from cgwm.datasets.capture.cameras import to_intrinsics
from cgwm.pipeline.fit import fit
from cgwm.pipeline.rendering.image_metrics import psnr
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.schemas import CamerasFile, PosedImage, Scale, SplatConfig
from mesh_photos import scanned
from object_photos import HEIGHT, WIDTH, Session, camera_matrix, photograph, poses
from store import Store

LAMPS_DEG = (0.0, 45.0, 90.0, 180.0)


def main() -> None:
    """Fit, measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("ycb", type=Path)
    parser.add_argument("--object", default="mustard_bottle")
    parser.add_argument("--gloss", type=float, default=0.4)
    arguments = parser.parse_args()
    painted = scanned(arguments.ycb / arguments.object)
    session = Session(
        count=40, focal_px=700.0, k1=0.0, motion="hand", background="white", gloss=arguments.gloss, seed=7
    )
    lens = {"width": WIDTH, "height": HEIGHT, "K": camera_matrix(session), "distortion": np.zeros(0)}
    cameras = {f"{k:03d}.png": Camera(**lens, T_world_cam=pose) for k, pose in enumerate(poses(session, painted.mesh))}
    store = Store("gloss")
    with tempfile.TemporaryDirectory() as folder:
        root, out = Path(folder) / "capture", Path(folder) / "model"
        write_capture(root, cameras, *photograph(painted, session))
        config = SplatConfig(device="cpu", turntable=False, gloss=True)
        fit(root, out, stage="sg-gs", splat_config=config)
        glossy = read_model(out)
        plain = replace(
            glossy, body_splats={name: replace(one, harmonics=None) for name, one in glossy.body_splats.items()}
        )
        held_out = Capture.open(root).photos()[:: config.test_every]
        for lamp in LAMPS_DEG:
            photos, masks = photograph(painted, replace(session, lamp_deg=lamp))
            found = {}
            for kind, model in (("plain", plain), ("gloss", glossy)):
                errors = [error(model, cameras[n], photos[int(n[:3])], masks[int(n[:3])]) for n in held_out]
                found[f"{kind}_db"] = round(float(np.mean(errors)), 2)
            store.add(f"{arguments.object} gloss {arguments.gloss:g} lamp {lamp:g}", found)


def error(model, camera: Camera, photo: np.ndarray, mask: np.ndarray) -> float:
    """Return the PSNR [dB] inside the object."""
    import torch

    pose = model.file.bodies[0].photo_pose
    renderer = LabelRenderer(replace(model, scene=None), {"a": camera})
    block = next(iter(renderer.blocks(np.array([[pose.position_m]]), np.array([[pose.quat_wxyz]]))))
    picture, truth = (torch.tensor(image.astype(np.float32) / 255) for image in (block.image[0], photo))
    return psnr(picture, truth, torch.tensor(mask > 0))


def write_capture(root: Path, cameras: dict[str, Camera], photos: list, masks: list) -> None:
    """Write photos, masks and true cameras."""
    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    for name, photo, mask in zip(cameras, photos, masks, strict=True):
        write_image(root / "images" / name, photo)
        write_image(root / "masks" / name, mask)
    images = {
        name: PosedImage(camera="a", T_world_cam=tuple(map(tuple, camera.T_world_cam.tolist())))  # type: ignore[arg-type]
        for name, camera in cameras.items()
    }
    scale = Scale(kind="metric", source="truth", relative_std=0.0)
    file = CamerasFile(scale=scale, cameras={"a": to_intrinsics(next(iter(cameras.values())))}, images=images)
    (root / "cameras.json").write_text(file.model_dump_json() + "\n", encoding="utf-8")
    (root / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "object"\n', encoding="utf-8")


if __name__ == "__main__":
    main()
