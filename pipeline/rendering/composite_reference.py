"""Front-to-back compositing of tile lists in torch, with a hand-written derivative.

The alpha of a sphere at a pixel is exp(basis . coefficients): in the frame of a tile, whose z axis is the ray through
the tile's centre, the squared distance from a centre p to the ray (x, y, 1) is a quadratic polynomial of (x, y),

    dist^2 (1 + x^2 + y^2) = (px - pz x)^2 + (py - pz y)^2 + (px y - py x)^2          (derived: |p x d|^2 / |d|^2)

so exponents are one small matrix product per tile, and so are their derivatives. No array of the size pixels times
spheres is kept between the forward and the backward pass; the latter computes it again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

MAX_ALPHA = 0.99
"""Maximum alpha of a sphere at a pixel, because the derivative divides by 1 - alpha."""
_CHUNK = 32
"""Number of spheres per tile that are evaluated together."""
_ELEMENTS = {"cpu": 400_000, "cuda": 40_000_000}
"""Maximum number of elements of the largest arrays of a batch of tiles, by device."""


@dataclass(frozen=True, kw_only=True)
class TileLists:
    """Rows of the pair arrays that each tile composites, nearest first."""

    basis: Tensor
    """Monomials (1, x, y, x^2, x y, y^2) / (1 + x^2 + y^2) of the pixels in the tile frame, shape (K, P, 6)."""
    frame: Tensor
    """Row of `basis` for each tile, shape (T,)."""
    starts: Tensor
    """First row of each tile's list in the pair arrays, shape (T,)."""
    counts: Tensor
    """Length of each tile's list, shape (T,)."""
    min_alpha: float
    """Threshold below which an alpha counts as 0."""
    min_transmittance: float
    """Transmittance of all pixels at which a tile is finished."""


@dataclass(kw_only=True)
class _Chunk:
    """Up to 32 successive spheres of each of some tiles: t tiles, L spheres, P pixels."""

    tiles: Tensor
    """Indices of the tiles in the batch, shape (t,)."""
    rows: Tensor
    """Rows of the pair arrays, whose last row is empty, shape (t, L)."""
    basis: Tensor
    """See `TileLists`, shape (t, P, 6)."""
    alpha: Tensor
    """Alpha of each sphere at each pixel, shape (t, L, P)."""
    clamped: Tensor | None
    """Whether alpha was limited to MAX_ALPHA, shape (t, L, P); None where none was."""
    weights: Tensor
    """Contribution of each sphere to alpha, shape (t, L, P)."""
    transmittance: Tensor
    """Transmittance before each sphere, shape (t, L, P)."""


def composite(
    coefficients: Tensor, features: Tensor, lists: TileLists, median: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite the spheres of each tile front to back.

    Args:
        coefficients: Exponent coefficients of each (tile, sphere) pair, shape (M, 6).
        features: Features of each pair, shape (M, F).
        lists: The tiles.
        median: Whether to compute the median of the last feature.

    Returns:
        Features (T, P, F), not divided by alpha; alpha (T, P); and the last feature of the sphere at which the
        transmittance falls to half (T, P), without derivative, zero where it does not or was not requested.
    """
    return _Composite.apply(coefficients, features, lists, median)  # type: ignore[return-value]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, coefficients: Tensor, features: Tensor, lists: TileLists, median: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        tile_count, pixel_count = lists.counts.shape[0], lists.basis.shape[1]
        out = features.new_zeros(tile_count, pixel_count, features.shape[1])
        left = features.new_ones(tile_count, pixel_count)
        middle = features.new_zeros(tile_count, pixel_count)
        table, padded_features = _with_empty_row(coefficients, features, lists)
        for batch in _batches(lists):
            remaining = features.new_ones(batch.shape[0], pixel_count)
            for chunk in _chunks(table, lists, batch, remaining):
                values = chunk.weights.transpose(1, 2) @ padded_features[chunk.rows]
                out.index_add_(0, batch[chunk.tiles], values)
                if median:
                    before = chunk.transmittance
                    crossed = (before > 0.5) & (before - chunk.weights <= 0.5)
                    last = padded_features[chunk.rows, -1][..., None]
                    middle.index_add_(0, batch[chunk.tiles], torch.where(crossed, last, 0.0).sum(1))
            left[batch] = remaining
        ctx.save_for_backward(coefficients, features, out, left)
        ctx.lists = lists
        ctx.mark_non_differentiable(middle)
        return out, 1 - left, middle

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        coefficients, features, out, left = ctx.saved_tensors
        lists: TileLists = ctx.lists
        grad_out, grad_alpha = (gradient.contiguous() for gradient in gradients[:2])
        # Contribution of all that lies behind a sphere: the total minus each sphere that has been passed.
        behind = (out * grad_out).sum(-1) - grad_alpha * left
        table, padded_features = _with_empty_row(coefficients, features, lists)
        grad_table, grad_features = torch.zeros_like(table), torch.zeros_like(padded_features)
        for batch in _batches(lists):
            remaining = torch.ones_like(left[batch])
            rest, grad_batch = behind[batch], grad_out[batch]
            for chunk in _chunks(table, lists, batch, remaining):
                grad_pixels = grad_batch[chunk.tiles]
                grad_features[chunk.rows] = chunk.weights @ grad_pixels
                along = padded_features[chunk.rows] @ grad_pixels.transpose(1, 2)
                grad_exponent = _grad_exponent(chunk, along, rest)
                grad_table[chunk.rows] = grad_exponent @ chunk.basis
        return grad_table[:-1], grad_features[:-1], None, None


def _grad_exponent(chunk: _Chunk, along: Tensor, rest: Tensor) -> Tensor:
    """Return the derivative with respect to the exponents (t, L, P), and advance `rest` past the chunk.

    d out / d alpha_i = T_i f_i - sum_(j > i) w_j f_j / (1 - alpha_i), and d alpha / d exponent = alpha.
    """
    passed = (chunk.weights * along).cumsum_(1)
    suffix = rest[chunk.tiles][:, None] - passed
    rest[chunk.tiles] = suffix[:, -1]
    keep = 1 - chunk.alpha
    gradient = along.mul_(chunk.transmittance).sub_(suffix.div_(keep)).mul_(chunk.alpha)
    if chunk.clamped is not None:
        gradient.masked_fill_(chunk.clamped, 0.0)
    return gradient


def _with_empty_row(coefficients: Tensor, features: Tensor, lists: TileLists) -> tuple[Tensor, Tensor]:
    """Append a row that is invisible, which pads lists to a common length."""
    nothing = coefficients.new_zeros(1, 6)
    nothing[0, [0, 3, 5]] = -1e4
    return torch.cat([coefficients, nothing]), torch.cat([features, features.new_zeros(1, features.shape[1])])


def _batches(lists: TileLists) -> Iterator[Tensor]:
    """Yield batches of tiles that are small enough for the cache (CPU) or for the memory (CUDA)."""
    order = torch.argsort(lists.counts, descending=True, stable=True)
    order = order[: int((lists.counts > 0).sum())]
    limit = _ELEMENTS.get(lists.basis.device.type, _ELEMENTS["cuda"])
    size = max(1, limit // (lists.basis.shape[1] * _CHUNK))
    yield from order.split(size)


def _chunks(table: Tensor, lists: TileLists, batch: Tensor, remaining: Tensor) -> Iterator[_Chunk]:
    """Yield the chunks of a batch of tiles from near to far, and update the transmittance `remaining` (t, P)."""
    starts, counts, frames = lists.starts[batch], lists.counts[batch], lists.frame[batch]
    empty = table.shape[0] - 1
    first = 0
    while True:
        open_tiles = counts > first
        if lists.min_transmittance > 0 and first > 0:
            open_tiles &= remaining.amax(1) > lists.min_transmittance
        tiles = open_tiles.nonzero()[:, 0]
        if tiles.shape[0] == 0:
            return
        length = min(_CHUNK, int(counts[tiles].max()) - first)
        places = torch.arange(first, first + length, device=table.device)
        rows = torch.where(places < counts[tiles, None], starts[tiles, None] + places, empty)
        yield _evaluate(table, lists, tiles, rows, frames[tiles], remaining)
        first += length


def _evaluate(
    table: Tensor, lists: TileLists, tiles: Tensor, rows: Tensor, frames: Tensor, remaining: Tensor
) -> _Chunk:
    basis = lists.basis[frames]
    alpha = (table[rows] @ basis.transpose(1, 2)).exp_()
    if lists.min_alpha > 0:
        torch.threshold_(alpha, lists.min_alpha, 0.0)
    clamped = None
    if alpha.amax() > MAX_ALPHA:
        clamped = alpha > MAX_ALPHA
        alpha.clamp_max_(MAX_ALPHA)
    transmittance = torch.empty_like(alpha)
    transmittance[:, 0] = remaining[tiles]
    keep = 1 - alpha
    for index in range(1, rows.shape[1]):
        torch.mul(transmittance[:, index - 1], keep[:, index - 1], out=transmittance[:, index])
    remaining[tiles] = transmittance[:, -1] * keep[:, -1]
    return _Chunk(
        tiles=tiles,
        rows=rows,
        basis=basis,
        alpha=alpha,
        clamped=clamped,
        weights=alpha * transmittance,
        transmittance=transmittance,
    )
