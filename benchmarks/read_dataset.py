"""How fast `RolloutDataset` reads: windows in random order, alone and with DataLoader workers.

A frame is one camera's image, as everywhere. Run `python benchmarks/read_dataset.py DATASET`.
"""

from __future__ import annotations

import argparse
import time

import torch
from cgwm.datasets.rollouts.loader import RolloutDataset
from torch.utils.data import DataLoader

KINDS = {"colour": ("image",), "colour, depth, mask": ("image", "depth", "mask")}


def frames_per_s(windows: RolloutDataset, workers: int, batch: int, epochs: int) -> tuple[float, float]:
    """Return camera images a second, and a second of this process's CPU time.

    The first epoch, in which workers start and files open, does not count.
    """
    torch.manual_seed(0)
    images = windows.length * len(windows.cameras)
    loader: DataLoader[dict[str, torch.Tensor]] = DataLoader(
        windows,  # pyright: ignore[reportArgumentType]
        batch_size=batch,
        shuffle=True,
        num_workers=workers,
        persistent_workers=workers > 0,
    )
    sum(len(item["start"]) for item in loader)
    began, used = time.perf_counter(), time.process_time()
    count = sum(len(item["start"]) for _ in range(epochs) for item in loader)
    return count * images / (time.perf_counter() - began), count * images / (time.process_time() - used)


def main() -> None:
    """Print frames a second by keys, window and workers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--length", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--epochs", type=int, default=3)
    options = parser.parse_args()
    print("| keys | window | a CPU second, alone | " + " | ".join(f"{n} workers" for n in options.workers) + " |")
    print("| --- | --- | --- |" + " --- |" * len(options.workers))
    for name, kinds in KINDS.items():
        keys = ["bodies/pos", "bodies/quat_wxyz", *(f"obs/{{camera}}_{kind}" for kind in kinds)]
        for length in options.length:
            windows = RolloutDataset(options.dataset, length=length, keys=keys)
            speeds = [frames_per_s(windows, workers, options.batch, options.epochs) for workers in options.workers]
            alone = [used for workers, (_, used) in zip(options.workers, speeds, strict=True) if workers == 0]
            numbers = [*(alone or [float("nan")]), *(speed for speed, _ in speeds)]
            print(f"| {name} | {length} | " + " | ".join(f"{number:,.0f}" for number in numbers) + " |", flush=True)


if __name__ == "__main__":
    main()
