"""Prepare the cache of scanned objects, and print how far their shapes lie from the scans.

    cd benchmarks && python -m tabletop.prepare [object ...]

Needs the extra `benchmarks` and the YCB archive; captures are then made from the cache alone. An object that is in the
cache already is only printed.
"""

from __future__ import annotations

import sys
import time

from .decompose import prepare_scan
from .objects import SCANS
from .scans import cache_folder, cache_path, read_scan, write_scan


def main(names: tuple[str, ...]) -> None:
    """Prepare and print the named scans."""
    cache_folder().mkdir(parents=True, exist_ok=True)
    print("object          parts corners  scan to solid (mm)     solid to scan (mm)     visible to")
    print("                               mean   99 %   max      mean   99 %   max      collision     kB       s")
    for name in names:
        path, start = cache_path(name), time.perf_counter()
        if not path.exists():
            write_scan(path, prepare_scan(name, cache_folder() / "raw"))
        scan = read_scan(name)
        solid = scan.solid
        figures = "   ".join(
            f"{1e3 * one.mean_m:6.3f} {1e3 * one.p99_m:6.3f} {1e3 * one.max_m:6.3f}"
            for one in (scan.scan_to_solid, scan.solid_to_scan)
        )
        print(
            f"{name:15} {len(solid.parts):5} {sum(len(part) for part in solid.parts):7} {figures}    0 (the same)"
            f" {path.stat().st_size / 1024:6.0f}  {time.perf_counter() - start:6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main(tuple(sys.argv[1:]) or SCANS)
