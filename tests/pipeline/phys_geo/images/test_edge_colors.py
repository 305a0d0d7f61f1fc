"""Colours at the edges of a body stay within those of their sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.phys_geo.images.edge_colors import LEAST_SPREAD, REACH, even_edges
from numpy.typing import NDArray

SIDE = 12


def corner(seed: int = 0) -> tuple[Splats, NDArray[np.bool_]]:
    """Return two sides of a body that meet at an edge, one dark and one bright, and which spheres lie at the edge."""
    across, along = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5))
    zero = np.zeros(SIDE * SIDE)
    means = 0.004 * np.concatenate([np.stack([across, along, zero], 1), np.stack([zero, along, -across], 1)])
    normals = np.repeat([[0.0, 0, 1], [-1.0, 0, 0]], SIDE * SIDE, axis=0)
    plain = np.repeat([[0.2], [0.7]], SIDE * SIDE, axis=0)
    colors = plain + 0.03 * np.random.default_rng(seed).standard_normal((len(means), 3))
    count = len(means)
    splats = Splats(
        means=means, scales=np.full(count, 0.002), opacities=np.full(count, 0.95), colors=colors, normals=normals
    )
    return splats, np.tile(across < 1, 2)


def test_a_fringe_at_an_edge_gets_the_colours_of_its_side() -> None:
    splats, edge = corner()
    fringe = np.array(splats.colors)
    fringe[edge] = np.where(np.arange(edge.sum())[:, None] % 2, 0.0, 1.0)  # black and white in turn
    found = even_edges(replace(splats, colors=fringe))
    off = np.abs(found.colors - np.repeat([[0.2], [0.7]], SIDE * SIDE, axis=0))
    assert off[edge].max() < 3 * 0.03 + 2 * REACH * LEAST_SPREAD
    away = np.abs(splats.means[:, :1]) + np.abs(splats.means[:, 2:]) > 0.008
    np.testing.assert_array_equal(found.colors[away[:, 0]], splats.colors[away[:, 0]])


def test_texture_and_bodies_without_edges_stay() -> None:
    splats, edge = corner(1)
    found = even_edges(splats)
    assert np.median(np.abs(found.colors - splats.colors)[edge]) == 0.0  # what its side has is no fringe
    flat = replace(splats, normals=np.tile([[0.0, 0, 1]], (len(splats), 1)))
    assert even_edges(flat) is flat
