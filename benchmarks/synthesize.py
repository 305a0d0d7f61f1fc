"""Labelled frames per second, end to end to disk, and what bounds them.

python benchmarks/synthesize.py [--device auto|cpu|cuda] [--rollouts N] [--duration S] [--folder DIR] [--only NAME ...]

A cube of 5,000 visual spheres (64 that collide) is thrown over a scene of 20,000; 320 x 240 px, two cameras, 30 Hz;
RGB, depth, masks, amodal masks, poses, contacts and forces, zstd. A frame is one camera's. "end_to_end" is `cgwm
synthesize` from the model on disk to the published, hashed dataset, without its preview; "end_to_end_workers" the same
with `--workers`, in 4 processes. What follows is each part alone, on the same
rollouts: what would be reached if nothing else took time. `gpu_waits` is the share of the time in which the GPU has
nothing to do.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import synthesize_model
import torch
from cgwm.datasets.io.processors import processors
from cgwm.datasets.models.model import read_model
from cgwm.datasets.rollouts import chunks
from cgwm.datasets.rollouts.rollout_writer import RolloutWriter, _encoded_images
from cgwm.datasets.rollouts.rollouts import FrameBlock
from cgwm.pipeline.runtime.device import resolve_device
from cgwm.pipeline.runtime.timing import Stopwatch
from cgwm.pipeline.synthesize import job, stage
from cgwm.pipeline.synthesize.draw import draw_rollout
from cgwm.pipeline.synthesize.labels import labels_of
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.pipeline.synthesize.simulator import Motion
from cgwm.schemas import SynthesizeConfig
from store import Store

CAMERAS = 2
WORKERS = 4
ROLLOUTS = {"cuda": 256, "cpu": 2}
DURATION_S = {"cuda": 2.0, "cpu": 1.0}
ALONE_FRAMES = {"cuda": 20_000, "cpu": 200}


@dataclass(frozen=True)
class Bench:
    """What is measured: the model's folder, the settings, and where the files go."""

    model: Path
    folder: Path
    config: SynthesizeConfig

    @property
    def device(self) -> str:
        """Cpu or cuda."""
        return str(resolve_device(self.config.device))

    def end_to_end(self, compression: str) -> dict[str, Any]:
        """Return the speed of the whole."""
        config = self.config.model_copy(update={"compression": compression})
        if self.device == "cuda":  # compiles kernels, fills pools of memory
            self._run(config.model_copy(update={"rollouts": 64}))
        stopwatch, cpu = Stopwatch(), time.process_time()
        summary, wall_s = self._run(config, stopwatch)
        cpu_s = time.process_time() - cpu
        figures = {
            "frames_per_s": summary.frames / wall_s,
            "frames_per_core_s": summary.frames / cpu_s,
            "frames": summary.frames,
            "kilobytes_a_frame": summary.bytes / summary.frames / 1e3,
            "wall_s": wall_s,
            "cores_busy": cpu_s / wall_s,
            "seconds": {name: round(value, 3) for name, value in sorted(stopwatch.seconds.items())},
        }
        if self.device == "cuda":
            figures["gpu_waits"] = 1 - stopwatch.gpu_seconds() / wall_s
        return figures

    def end_to_end_workers(self) -> dict[str, Any]:
        """Return the speed of the whole in several processes, which share the cores and the GPU.

        Of two datasets: what the larger one has more, by the time that it takes more, is the speed once the processes
        run; `frames_per_s` of each counts their beginning too.
        """
        count = min(WORKERS, processors())
        few = self.config.model_copy(update={"shards": 2 * count, "rollouts": max(self.config.rollouts, 2 * count)})
        many = few.model_copy(update={"rollouts": 3 * few.rollouts})
        runs = []
        for config in (few, many):
            out = self.folder / "dataset"
            began = time.perf_counter()
            summary = synthesize_shards(self.model, out, config, workers=count)
            runs.append((summary.frames, time.perf_counter() - began))
            shutil.rmtree(out)
        (few_frames, few_s), (many_frames, many_s) = runs
        return {
            "workers": count,
            "frames": many_frames,
            "wall_s": many_s,
            "frames_per_s": many_frames / many_s,
            "frames_per_s_fewer": few_frames / few_s,
            "frames_per_s_running": (many_frames - few_frames) / (many_s - few_s),
        }

    def _run(self, config: SynthesizeConfig, stopwatch: Stopwatch | None = None) -> tuple[Any, float]:
        began = time.perf_counter()
        out = self.folder / "dataset"
        summary = stage.synthesize(self.model, out, config, overwrite=True, stopwatch=stopwatch)
        wall_s = time.perf_counter() - began
        shutil.rmtree(out)
        return summary, wall_s

    def job(self) -> Any:
        """Return what the stage prepares once."""
        return job.prepared(self.model, self.config)

    def motions(self, job: Any, count: int) -> list[Motion]:
        """Return the first rollouts."""
        duration_s = float(job.times_s[-1])
        draws = [
            draw_rollout(job.model, job.plan, job.config, job.cameras, duration_s, index) for index in range(count)
        ]
        found = job.simulator.run(draws, self.config.seed)
        assert all(isinstance(motion, Motion) for motion in found)
        return found

    def simulate(self) -> dict[str, Any]:
        """Return the speed of drawing and simulating, with the contacts of every frame."""
        job, count = self.job(), ROLLOUTS[self.device]
        self.motions(job, 1)
        began = time.perf_counter()
        motions = self.motions(job, count)
        wall_s = time.perf_counter() - began
        frames = CAMERAS * sum(len(motion.position_m) for motion in motions)
        return {"frames_per_s": frames / wall_s, "rollouts_per_s": count / wall_s}

    def labels(self) -> dict[str, Any]:
        """Return the speed of what Python makes of a simulated rollout before its images: states, MJCF, forces."""
        job = self.job()
        (motion,) = self.motions(job, 1)
        began, count = time.perf_counter(), 50
        for _ in range(count):
            labels_of(motion, job.plan, self.config.seed, job.times_s)
        wall_s = time.perf_counter() - began
        return {"frames_per_s": CAMERAS * count * len(motion.position_m) / wall_s, "milliseconds": 1e3 * wall_s / count}

    def render(self) -> dict[str, Any]:
        """Return the speed of rendering, labels in the memory of the host, nothing compressed."""
        job = self.job()
        (motion,) = self.motions(job, 1)
        rounds = max(1, ALONE_FRAMES[self.device] // (CAMERAS * len(motion.position_m)))
        poses, last = (motion.position_m, motion.quat_wxyz), None
        if self.device == "cuda":
            list(job.renderer.blocks(*poses))
        began = time.perf_counter()
        for _ in range(rounds):
            *_, last = job.renderer.blocks(*poses, wait=False)
        if last is not None and last.ready is not None:
            last.ready()
        wall_s = time.perf_counter() - began
        return {"frames_per_s": CAMERAS * rounds * len(motion.position_m) / wall_s}

    def blocks(self, job: Any) -> tuple[Any, list[FrameBlock]]:
        """Return the labels of one rollout and its images, in memory."""
        (motion,) = self.motions(job, 1)
        found = job.renderer.blocks(motion.position_m, motion.quat_wxyz)
        return labels_of(motion, job.plan, self.config.seed, job.times_s), [
            replace(block, ready=None) for block in found
        ]

    def compress(self) -> dict[str, Any]:
        """Return the speed of zstd, one thread and as many as there are processors."""
        _, blocks = self.blocks(self.job())
        figures: dict[str, Any] = {"processors": processors()}
        for threads in (1, processors()):
            rounds = max(1, ALONE_FRAMES[self.device] // (4 * sum(len(block.image) for block in blocks)))
            work = blocks * rounds
            with ThreadPoolExecutor(threads) as pool:
                began = time.perf_counter()
                list(pool.map(lambda block: _encoded_images(block, "zstd", 8), work))
                wall_s = time.perf_counter() - began
            figures["frames_per_s" if threads > 1 else "frames_per_s_one_thread"] = (
                sum(len(block.image) for block in work) / wall_s
            )
        return figures

    def write(self) -> dict[str, Any]:
        """Return the speed of the writer with its threads, images from memory, to disk without waiting for it."""
        labels, blocks = self.blocks(self.job())
        rounds = max(1, ALONE_FRAMES[self.device] // (CAMERAS * len(labels.time_s)))
        began = time.perf_counter()
        with RolloutWriter(self.folder / "alone.h5", 0, "{}", "benchmark") as writer:
            for index in range(rounds):
                writer.write(replace(labels, episode_index=index), blocks)
        wall_s = time.perf_counter() - began
        (self.folder / "alone.h5").unlink()
        began = time.perf_counter()
        with RolloutWriter(self.folder / "tables.h5", 0, "{}", "benchmark") as writer:
            for index in range(50):
                writer.write(replace(labels, episode_index=index, cameras=None))
        tables_s = (time.perf_counter() - began) / 50
        return {
            "frames_per_s": CAMERAS * rounds * len(labels.time_s) / wall_s,
            "milliseconds_of_tables_a_rollout": 1e3 * tables_s,
        }

    def depth_layout(self) -> dict[str, Any]:
        """Return size and time of a frame's depth with and without shuffled bytes, one thread."""
        _, blocks = self.blocks(self.job())
        depth = np.concatenate([block.depth for block in blocks if len(block.depth) == 8])
        figures = {}
        for name in ("plain", "shuffled"):
            began, size = time.perf_counter(), 0
            for first in range(0, len(depth), 8):
                raw = depth[first : first + 8].reshape(-1).view(np.uint8)
                if name == "shuffled":
                    raw = np.ascontiguousarray(raw.reshape(-1, 4).T)
                size += len(chunks.zstd_module().compress(raw.data, 1))
            seconds = time.perf_counter() - began
            figures[name] = {"kilobytes": size / len(depth) / 1e3, "milliseconds": 1e3 * seconds / len(depth)}
        return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--rollouts", type=int)
    parser.add_argument("--duration", type=float)
    parser.add_argument("--folder", type=Path, help="for the dataset; a temporary one where left out")
    parser.add_argument("--only", nargs="*", default=[], help="names of measurements")
    options = parser.parse_args()
    device = options.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    config = SynthesizeConfig(
        seed=0,
        device=device,
        rollouts=options.rollouts or ROLLOUTS[device],
        duration_s=options.duration or DURATION_S[device],
    )
    store = Store("synthesize")
    with tempfile.TemporaryDirectory(dir=options.folder) as temporary:
        folder = Path(temporary)
        bench = Bench(synthesize_model.write(folder / "model"), folder, config)
        read_model(bench.model)
        measures = {
            "end_to_end": lambda: bench.end_to_end("zstd"),
            "end_to_end_workers": bench.end_to_end_workers,
            "end_to_end_jpeg": lambda: bench.end_to_end("jpeg"),
            "end_to_end_uncompressed": lambda: bench.end_to_end("none"),
            "simulate": bench.simulate,
            "labels": bench.labels,
            "render": bench.render,
            "compress": bench.compress,
            "write": bench.write,
            "depth_layout": bench.depth_layout,
        }
        name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
        for key, measure in measures.items():
            if not options.only or key in options.only:
                store.add(f"{device}/{key}", {"device": name, **measure()})


if __name__ == "__main__":
    main()
