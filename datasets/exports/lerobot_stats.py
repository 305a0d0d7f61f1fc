"""LeRobot's statistics of one and of all episodes: minimum, maximum, mean, deviation, count and five quantiles.

Source: lerobot 0.4, `datasets/compute_stats.py`. Deviations are population deviations; image values are in [0, 1],
shape (3, 1, 1), counted by frame; quantiles of all episodes are count-weighted means of their quantiles, as in LeRobot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_SAMPLED_FRAMES = 100
_SAMPLED_SIDE = 150

Stats = dict[str, NDArray[np.float64]]


def vector_stats(values: NDArray[np.floating]) -> Stats:
    """Return the statistics of a feature, shape (T, D), each (D,), and the count (1,)."""
    table = np.asarray(values, np.float64)
    return _stats(table, len(table))


class PictureStats:
    """Collects the images of an episode, subsampled as in LeRobot: about 100 frames, and every n-th pixel."""

    def __init__(self, frames: int):
        self._wanted = set(np.round(np.linspace(0, frames - 1, min(frames, _SAMPLED_FRAMES))).astype(int).tolist())
        self._seen = 0
        self._kept: list[NDArray[np.uint8]] = []

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add the next image, uint8 RGB (H, W, 3)."""
        if self._seen in self._wanted:
            step = max(1, max(image.shape[:2]) // _SAMPLED_SIDE)
            self._kept.append(image[::step, ::step].reshape(-1, 3))
        self._seen += 1

    def stats(self) -> Stats:
        """Return the statistics of all channels, each (3, 1, 1), and the number of frames (1,)."""
        found = _stats(np.concatenate(self._kept).astype(np.float64) / 255, len(self._kept))
        return {name: value if name == "count" else value.reshape(3, 1, 1) for name, value in found.items()}


def together(episodes: Sequence[Mapping[str, Stats]]) -> dict[str, Stats]:
    """Return the statistics of all episodes together, by feature."""
    return {key: _joined([episode[key] for episode in episodes]) for key in episodes[0]}


def _stats(table: NDArray[np.float64], count: int) -> Stats:
    found = {"min": table.min(0), "max": table.max(0), "mean": table.mean(0), "std": table.std(0)}
    found |= dict(zip(QUANTILES, np.quantile(table, list(QUANTILES.values()), axis=0), strict=True))
    return {**found, "count": np.array([count])}


def _joined(parts: Iterable[Stats]) -> Stats:
    parts = list(parts)
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    count = stacked["count"][:, 0].astype(np.float64)

    def weighted(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.tensordot(count, values, 1) / count.sum()

    mean = weighted(stacked["mean"])
    joined = {name: weighted(stacked[name]) for name in QUANTILES}
    variance = weighted(stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)
    low, high = stacked["min"].min(0), stacked["max"].max(0)
    return {"min": low, "max": high, "mean": mean, "std": np.sqrt(variance), **joined, "count": stacked["count"].sum(0)}
