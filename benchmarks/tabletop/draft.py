"""The draft of a capture's motions: what was drawn so far, so that a long search that is cut off goes on."""

from __future__ import annotations

import json
from collections.abc import MutableMapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cgwm.datasets.io.atomic import replaced_file
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Draft:
    """How the episodes of a capture begin, in a file; with none, nothing is kept.

    Args:
        path: The file, JSON, or None.
    """

    path: Path | None = None

    def read(self, rng: np.random.Generator, rejected: MutableMapping[str, int]) -> list[Array]:
        """Return the beginnings of the episodes drawn so far; set `rng` and `rejected` as they were after them."""
        if self.path is None or not self.path.exists():
            return []
        kept = json.loads(self.path.read_text(encoding="utf-8"))
        rng.bit_generator.state = kept["rng"]
        rejected.update(kept["rejected"])
        return [np.array(one) for one in kept["beginnings"]]

    def write(self, rng: np.random.Generator, rejected: MutableMapping[str, int], beginnings: list[Array]) -> None:
        """Keep the beginnings of the episodes drawn so far, with what was left out and the state of `rng`."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            kept = {
                "rng": rng.bit_generator.state,
                "rejected": dict(rejected),
                "beginnings": [one.tolist() for one in beginnings],
            }
            with replaced_file(self.path) as partial:
                partial.write_text(json.dumps(kept), encoding="utf-8")


NO_DRAFT = Draft()
