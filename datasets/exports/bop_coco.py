"""A BOP scene's masks and boxes as COCO annotations, `scene_gt_coco.json`.

Source: bop_toolkit, `scripts/calc_gt_coco.py` and `pycoco_utils.py`: boxes of amodal masks, run lengths of visible
masks (column-major, starting with the background); bodies of which less than a tenth is visible are marked as ignored.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

LEAST_VISIBLE = 0.1


class CocoScene:
    """Collects the annotations of a scene.

    Args:
        bodies: Names of the bodies; body k is the category k + 1.
    """

    def __init__(self, bodies: list[str]):
        self._categories = [{"id": k, "name": name, "supercategory": "cgwm"} for k, name in enumerate(bodies, 1)]
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add_image(self, number: int, width: int, height: int) -> None:
        """Add an image, `rgb/<number>.png`."""
        self._images.append({"id": number, "file_name": f"rgb/{number:06d}.png", "width": width, "height": height})

    def add(self, image: int, body: int, visible: NDArray[np.bool_], silhouette: NDArray[np.bool_]) -> None:
        """Add the annotation of a body in an image, unless it is invisible; both masks have the shape (H, W)."""
        area = int(visible.sum())
        if area == 0:
            return
        rows, columns = np.nonzero(silhouette)
        left, top = int(columns.min()), int(rows.min())
        entry = {"id": len(self._annotations) + 1, "image_id": image, "category_id": body + 1, "iscrowd": 0}
        entry |= {"area": area, "bbox": [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]}
        entry |= {"segmentation": run_lengths(visible), "width": visible.shape[1], "height": visible.shape[0]}
        self._annotations.append({**entry, "ignore": bool(area < LEAST_VISIBLE * silhouette.sum())})

    def content(self) -> dict[str, Any]:
        """Return the content of the file."""
        about = {"description": "exported by cgwm", "version": "1"}
        parts = {"categories": self._categories, "images": self._images, "annotations": self._annotations}
        return {"info": about, "licenses": [], **parts}


def run_lengths(mask: NDArray[np.bool_]) -> dict[str, list[int]]:
    """Return COCO's uncompressed run lengths of a mask (H, W)."""
    flat = np.concatenate([[False], mask.ravel(order="F")])  # the first run is background, possibly of length 0
    edges = np.flatnonzero(flat[:-1] != flat[1:])
    return {"counts": np.diff(edges, prepend=0, append=mask.size).tolist(), "size": list(mask.shape)}
