"""The demo's scene `fall` over several seeds: errors on its test episodes against the targets.

python benchmarks/fall.py [--seeds 0,1,2,3,4]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from cgwm.pipeline.demo import run_demo
from store import Store


def measure(seed: int) -> dict[str, Any]:
    """Run the demo in a folder that is thrown away, and return its medians over the test episodes."""
    with tempfile.TemporaryDirectory() as folder:
        demo = run_demo(Path(folder) / "demo", seed=seed)
    covered = [row.covered for row in demo.parameters if row.covered is not None]
    return {
        "targets": [target.model_dump() for target in demo.targets],
        "intervals_hold": f"{sum(covered)}/{len(covered)}",
        "images_only": demo.images_only.model_dump(mode="json"),
        "seconds": demo.seconds,
        "peak_memory_bytes": demo.peak_memory_bytes,
    }


def main() -> int:
    """Print one JSON line a seed; return 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2,3,4")
    store, met = Store("fall"), []
    for seed in parser.parse_args().seeds.split(","):
        row = store.result(f"seed {seed}", lambda seed=seed: measure(int(seed)))
        met += [target["met"] for target in row["targets"]]
    print(f"{sum(met)} of {len(met)} targets met")
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
