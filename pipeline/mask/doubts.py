"""Which masks should be looked at: the body is not found, is cut off, or changes its size from photo to photo."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..foreground.graph_cut import Mask

_NEIGHBOURS = 2
"""Photos on either side with which the size of a mask is compared."""
_JUMP = 1.6
"""Ratio of sizes above which a mask is doubtful."""
_AT_BORDER = 0.02
"""Least share of the border of the photo that a mask covers, for a body that is cut off."""


def doubts(masks: Sequence[Mask]) -> list[str]:
    """Return why each mask (H, W) should be looked at, in the order of the photos; empty where nothing is seen."""
    shares = [float(mask.mean()) for mask in masks]
    return [_doubt(mask, shares, k) for k, mask in enumerate(masks)]


def _doubt(mask: Mask, shares: Sequence[float], k: int) -> str:
    if not mask.any():
        return "nothing of the body was found"
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if border.mean() > _AT_BORDER:
        return "the body reaches the border of the photo, or what is behind it was taken for it"
    near = [shares[j] for j in range(max(k - _NEIGHBOURS, 0), min(k + _NEIGHBOURS + 1, len(shares))) if j != k]
    near = [share for share in near if share > 0]
    if not near:
        return ""
    ratio = shares[k] / float(np.median(near))
    if max(ratio, 1 / ratio) > _JUMP:
        return f"the body has {ratio:.2g} times the size of that in the photos beside it"
    return ""
