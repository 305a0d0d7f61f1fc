"""The six objects: four YCB scans from the cache, a box and an L-shaped block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cgwm.datasets.synthetic.objects import FAMILIES, SolidObject, make_object, resting_down
from cgwm.datasets.synthetic.raycast import Material
from cgwm.datasets.synthetic.rig import make_paint
from numpy.typing import NDArray

from .paint import make_scan_paint
from .scans import read_scan

Array = NDArray[np.float64]

SCANS = ("mustard_bottle", "power_drill", "banana", "mug")
BUILT_IN = ("box", "l_block")
OBJECTS = (*SCANS, *BUILT_IN)


@dataclass(frozen=True)
class Item:
    """An object as it is filmed.

    Args:
        solid: The object.
        paint: Its material.
        down: Body direction that points down at rest, shape (3,).
        scan: Whether its surface is a scan's: small facets, drawn as one mesh.
    """

    solid: SolidObject
    paint: Material
    down: Array
    scan: bool


def load_item(name: str) -> Item:
    """Return one of `OBJECTS`; the same whatever the capture's seed.

    Raises:
        InputDataError: If it is a scan that is not in the cache.
    """
    if name in SCANS:
        scan = read_scan(name)
        return Item(scan.solid, make_scan_paint(scan), scan.down, scan=True)
    seed = FAMILIES.index(name)
    solid = make_object(seed)
    return Item(solid, make_paint(np.random.default_rng([seed, 6]), solid), resting_down(solid), scan=False)
