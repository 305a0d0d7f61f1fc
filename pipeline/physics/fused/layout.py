"""Parts of input arrays: batches joined, and vectors and orientations in the kernel's frame."""

from __future__ import annotations

import torch
from torch import Tensor

from ...geometry.rotation import quat_multiply, quat_normalize, quat_rotate


def joined(parts: list[Tensor]) -> Tensor:
    """Concatenate parts (1 or B, N, ...) along the second dimension; the first is 1 where it is 1 for all parts."""
    batch = max(len(part) for part in parts)
    return torch.cat([part.expand(batch, *part.shape[1:]) for part in parts], 1)


def upright(normal: Tensor) -> Tensor | None:
    """Return the rotation (4,) that takes the ground's normal to z; None where it is z."""
    x, y, z = normal.detach().tolist()
    if (x, y) == (0.0, 0.0) and z > 0:
        return None
    axis = [0.0, 1.0, 0.0, 0.0] if z < -1 + 1e-12 else [1 + z, y, -x, 0.0]
    return quat_normalize(normal.new_tensor(axis))


def in_frame(turn: Tensor | None, vector: Tensor) -> Tensor:
    """Return a vector (..., 3) of the world in the kernel's frame, given the rotation into it (4,)."""
    return vector if turn is None else quat_rotate(turn, vector)


def quat_in_frame(turn: Tensor | None, quat: Tensor) -> Tensor:
    """Return an orientation (..., 4) in the world as one in the kernel's frame."""
    return quat if turn is None else quat_multiply(turn, quat)
