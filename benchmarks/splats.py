"""The renderer on CUDA against gsplat, isotropic scenes, medians by CUDA events; and the torch twin on the CPU.

python benchmarks/splats.py [--sizes small|all] [--peer gsplat|none]

Forward alone and forward + backward of RGB, alpha and depth, of the same spheres and cameras. The pictures differ a
little: gsplat approximates the projection of a sphere, and widens it by 0.3 px. "graph" is the same call with room for
the pairs of tiles and spheres given, replayed as a CUDA graph; gsplat's cannot be captured, it waits for their number.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from cgwm.pipeline.rendering.rasterize import Raster, rasterize
from cgwm.pipeline.rendering.render import render
from torch import Tensor

SIZES = {
    "small": ((5_000, 1, 320, 240), (5_000, 16, 320, 240), (5_000, 64, 320, 240)),
    "all": (
        (5_000, 1, 320, 240),
        (5_000, 16, 320, 240),
        (5_000, 64, 320, 240),
        (20_000, 1, 640, 480),
        (20_000, 16, 640, 480),
        (100_000, 1, 1280, 720),
        (100_000, 8, 1280, 720),
        (1_000_000, 1, 1920, 1080),
    ),
}
WARMUP, REPEATS = 5, 30
THRESHOLDS = (1 / 255, 1e-4)
Scene = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Centres, scales, opacities, colours, view matrices and intrinsics."""
Call = Callable[[Scene], tuple[Tensor, ...]]


def scene(count: int, cameras: int, width: int, height: int, device: str, seed: int = 0) -> Scene:
    """Return spheres through the volume of a cube of 1 m, each some pixels wide, and cameras around it."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) - 0.5
    scales = 0.35 / count ** (1 / 3) * (0.5 + torch.rand(count, generator=generator))
    opacities = 0.1 + 0.85 * torch.rand(count, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    views = []
    for angle in torch.arange(cameras) * (2 * math.pi / cameras) + 0.3:
        c, s = math.cos(angle), math.sin(angle)
        views.append(torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 1.6], [0, 0, 0, 1]]))
    focal = 1.1 * height
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    tensors = (means, scales, opacities, colors, torch.stack(views), K.expand(cameras, 3, 3).contiguous())
    means, scales, opacities, colors, viewmats, Ks = (tensor.to(device) for tensor in tensors)
    return means, scales, opacities, colors, viewmats, Ks


def median_ms(call: Callable[[], object]) -> float:
    """Return the median time of a call on the device [ms]."""
    for _ in range(WARMUP):
        call()
    torch.cuda.synchronize()
    pairs = []
    for _ in range(REPEATS):
        pair = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
        pair[0].record()
        call()
        pair[1].record()
        pairs.append(pair)
    torch.cuda.synchronize()
    return statistics.median(first.elapsed_time(last) for first, last in pairs)


def captured_ms(call: Callable[[], object]) -> float:
    """Return the median time of a call's replay as a CUDA graph [ms]."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return median_ms(graph.replay)


def peer(tensors: Scene, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return gsplat's colour with depth as the fourth channel, and alpha."""
    import gsplat

    means, scales, opacities, colors, views, Ks = tensors
    quats = torch.zeros(len(means), 4, device=means.device)
    quats[:, 0] = 1
    spread = scales[:, None].expand(-1, 3)
    # its depth mode needs colours for each camera
    picture, alpha, _ = gsplat.rasterization(
        means, quats, spread, opacities, colors, views, Ks, width, height, render_mode="RGB+D", packed=False
    )
    return picture, alpha


def both_ways(call: Call, tensors: Scene) -> Callable[[], None]:
    """Return a call that renders and differentiates by centres, scales, opacities and colours."""
    leaves: Any = [tensor.clone().requires_grad_(k < 4) for k, tensor in enumerate(tensors)]
    grads: list[Tensor] = []

    def run() -> None:
        outputs = call(leaves)
        if not grads:
            generator = torch.Generator(device=outputs[0].device).manual_seed(1)
            grads.extend(torch.randn(o.shape, generator=generator, device=o.device) for o in outputs)
        torch.autograd.grad(outputs, leaves[:4], grads)

    return run


def measure(size: tuple[int, int, int, int], with_peer: bool) -> dict[str, object]:
    """Return the times of one size [ms]: calls as they are, and as replays of a CUDA graph."""
    count, cameras, width, height = size
    tensors = scene(count, cameras, width, height, "cuda")
    row: dict[str, object] = {"spheres": count, "cameras": cameras, "size": f"{width}x{height}"}
    others: list[tuple[str, Call]] = []
    if with_peer:
        others.append(("gsplat", lambda tensors: peer(tensors, width, height)))
    pairs = int(rasterize(*tensors, Raster(width, height, *THRESHOLDS))[4])
    row["pairs"] = pairs
    plain = Raster(width, height, *THRESHOLDS)
    roomy = Raster(width, height, *THRESHOLDS, capacity=int(1.25 * pairs))
    others.append(("cuda", lambda tensors: rasterize(*tensors, plain)[:3]))
    others.append(("cuda_graph", lambda tensors: rasterize(*tensors, roomy)[:3]))
    pictures = {}
    for name, call in others:
        clock = captured_ms if name.endswith("graph") else median_ms
        with torch.no_grad():
            pictures[name] = call(tensors)[0][..., :3]
            row[f"{name}_forward_ms"] = clock(lambda call=call: call(tensors))
        row[f"{name}_both_ms"] = clock(both_ways(call, tensors))
    if with_peer:
        row["mean_difference"] = float((pictures["cuda"] - pictures["gsplat"]).abs().mean())
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}


def cpu() -> dict[str, object]:
    """Return the time of the torch twin: 2,000 spheres at 200x200, forward and backward."""
    tensors = scene(2000, 1, 200, 200, "cpu")
    for leaf in tensors[:4]:
        leaf.requires_grad_(True)
    times = []
    for _ in range(8):
        began = time.perf_counter()
        render(*tensors, 200, 200).features.square().sum().backward()
        times.append(1e3 * (time.perf_counter() - began))
    return {"cpu_both_ms": round(statistics.median(times), 1), "threads": torch.get_num_threads()}


def main() -> int:
    """Print one JSON line a size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", choices=tuple(SIZES), default="all")
    parser.add_argument("--peer", choices=("gsplat", "none"), default="gsplat")
    options = parser.parse_args()
    print(json.dumps(cpu()), flush=True)
    if not torch.cuda.is_available():
        print("no CUDA device: only the CPU was measured")
        return 0
    print(torch.cuda.get_device_name(), torch.__version__, flush=True)
    for size in SIZES[options.sizes]:
        print(json.dumps(measure(size, options.peer == "gsplat")), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
