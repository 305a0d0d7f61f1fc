"""Held-out quality on real photos (`fox`, 540x960, every 8th held out) against gsplat's MCMC strategy, in one run.

python benchmarks/fox.py [--spheres 100000] [--iterations 7000] [--peer gsplat|none] [--exposure on|off]
    [--refine-poses] [--photos FOLDER]

Both get spheres (one scale for all axes), the same budget, harmonics of degree 3, photos and iterations, and both start
at random: gsplat's peer from the points from which its examples start, in the cameras' volume. Needs a CUDA device.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.rendering.image_metrics import psnr, ssim_map
from cgwm.pipeline.sg_gs.stage import fit_scene
from cgwm.pipeline.sg_gs.views import View, load_views
from cgwm.schemas import SplatConfig
from cgwm.schemas.config import Device
from store import shared_data
from torch import Tensor

SIZE, EVERY = 960, 8


def capture_of(photos: Path, folder: Path) -> Capture:
    """Return a capture of the photos and their cameras, made in `folder`."""
    shutil.copytree(photos / "images", folder / "images")
    shutil.copy(photos / "transforms.json", folder)
    (folder / "capture.toml").write_text('format = "cgwm-capture/1"\n', encoding="utf-8")
    return Capture.open(folder)


def ours(capture: Capture, spheres: int, iterations: int, device: Device, **settings: Any) -> dict[str, Any]:
    """Return the figures of the stage sg-gs."""
    config = SplatConfig(
        spheres=spheres,
        adaptive_iterations=iterations,
        image_size=SIZE,
        test_every=EVERY,
        device=device,
        turntable=False,
        **settings,
    )
    record = fit_scene(capture, config).record
    held_out, scene = record["held_out"], record["scene"]
    return {
        "method": "cgwm",
        **settings,
        "spheres": scene["spheres"],
        "psnr_db": held_out["psnr_db"],
        "ssim": held_out["ssim"],
        **{name: held_out[name] for name in ("psnr_right_half_db", "psnr_right_half_corrected_db") if name in held_out},
        "seconds": scene["seconds"],
    }


def peer(capture: Capture, spheres: int, iterations: int) -> dict[str, Any]:
    """Return the figures of gsplat: its MCMC strategy and its examples' settings, Gaussians held to be spheres."""
    import gsplat

    names = sorted(capture.photos())
    views = load_views(capture, names, SIZE, torch.device("cuda"))
    test, train = views[::EVERY], [view for k, view in enumerate(views) if k % EVERY]
    eyes = torch.stack([torch.as_tensor(view.camera.center, dtype=torch.float32) for view in views]).cuda()
    extent = 1.1 * float((eyes - eyes.mean(0)).norm(dim=1).max())
    generator = torch.Generator("cuda").manual_seed(0)
    start = int(0.3 * spheres)
    means = eyes.mean(0) + 3 * extent * (2 * torch.rand(start, 3, generator=generator, device="cuda") - 1)
    away = torch.cat(
        [torch.cdist(part, means).topk(4, largest=False).values[:, 1:].mean(1) for part in means.split(2048)]
    )
    colors = torch.rand(start, 3, generator=generator, device="cuda")
    values = {
        "means": means,
        "scales": away.log()[:, None].repeat(1, 3) - 2.3,
        "quats": torch.tensor([1.0, 0, 0, 0]).cuda().repeat(start, 1),
        "opacities": torch.zeros(start).cuda(),
        "sh0": ((colors - 0.5) / 0.28209479177387814)[:, None],
        "shN": torch.zeros(start, 15, 3).cuda(),
    }
    rates = {"means": 1.6e-4 * extent, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    adams = {
        name: torch.optim.Adam([{"params": params[name], "lr": rates[name], "name": name}], eps=1e-15, fused=True)
        for name in rates
    }
    strategy = gsplat.MCMCStrategy(cap_max=spheres, refine_stop_iter=int(0.85 * iterations))
    state = strategy.initialize_state()

    def draw(view: View, degree: int) -> tuple[Tensor, dict[str, Any]]:
        scales = params["scales"].mean(1, keepdim=True).exp().expand(-1, 3)  # one scale for all axes
        picture, _, info = gsplat.rasterization(
            params["means"],
            params["quats"],
            scales,
            torch.sigmoid(params["opacities"]),
            torch.cat([params["sh0"], params["shN"]], 1),
            view.viewmat[None],
            view.K[None],
            *view.size,
            sh_degree=degree,
            packed=False,
        )
        return picture[0], info

    order: list[int] = []
    torch.cuda.synchronize()
    began = time.perf_counter()
    for step in range(iterations):
        order = order or torch.randperm(len(train)).tolist()
        view = train[order.pop()]
        picture, info = draw(view, min(step // 1000, 3))
        strategy.step_pre_backward(params, adams, state, step, info)
        loss = 0.8 * (picture - view.image).abs().mean() + 0.2 * (1 - ssim_map(picture, view.image).mean())
        loss = loss + 0.01 * torch.sigmoid(params["opacities"]).mean() + 0.01 * params["scales"].exp().mean()
        loss.backward()
        rate = rates["means"] * 0.01 ** (step / iterations)
        adams["means"].param_groups[0]["lr"] = rate
        for adam in adams.values():
            adam.step()
            adam.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, adams, state, step, info, lr=rate)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - began
    with torch.no_grad():
        pictures = [draw(view, 3)[0].clamp(0, 1) for view in test]
    decibel = [psnr(picture, view.image) for picture, view in zip(pictures, test, strict=True)]
    similar = [float(ssim_map(picture, view.image).mean()) for picture, view in zip(pictures, test, strict=True)]
    return {
        "method": f"gsplat {gsplat.__version__}",
        "spheres": len(params["means"]),
        "psnr_db": round(sum(decibel) / len(decibel), 3),
        "ssim": round(sum(similar) / len(similar), 4),
        "seconds": round(seconds, 1),
    }


def main() -> int:
    """Print a JSON line for each method; return 1 if the goal of 22.4 dB is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spheres", type=int, default=100_000)
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--peer", choices=("gsplat", "none"), default="gsplat")
    parser.add_argument("--photos", type=Path, default=None)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--exposure", choices=("on", "off"), default="on", help="whether photos get a gain each")
    parser.add_argument("--refine-poses", action="store_true")
    options = parser.parse_args()
    data = shared_data()
    photos = options.photos or (data / "fox" if data else None)
    if photos is None or not photos.is_dir():
        print("no photos: give --photos, or set CGWM_SHARED_DATA", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        capture = capture_of(photos, Path(folder) / "fox")
        corrections = {"exposure": options.exposure == "on", "refine_poses": options.refine_poses}
        mine = ours(capture, options.spheres, options.iterations, options.device, **corrections)
        print(json.dumps(mine), flush=True)
        if options.peer == "gsplat":
            print(json.dumps(peer(capture, options.spheres, options.iterations)), flush=True)
    return 0 if mine["psnr_db"] >= 22.4 else 1


if __name__ == "__main__":
    sys.exit(main())
