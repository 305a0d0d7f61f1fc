"""Search for objects in photos without masks, among spheres that are fitted to all photos at a small size.

Some spheres lie on the ground and far away, others on a grid in the space that is searched. The spheres of the grid
start nearly transparent and become opaque where the photos require it. The opaque spheres above the ground are
clustered; a cluster is an object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from ....datasets.capture.capture import Capture
from ....schemas import Body, Ground, InputDataError, SplatConfig
from ...geometry.directions import upright_axes
from ...geometry.solid_grid import Array
from ...geometry.spheres import Spheres
from ..appearance.colors import mean_colors
from ..appearance.initialization import scene_seeds, to_spheres
from ..appearance.losses import scene_loss
from ..appearance.optimize import Rates, Trainable, descend
from ..photos.photo_exposure import Exposures
from ..photos.views import View, focus_of, render_view

_SIZE = 160
"""Maximum length of the longer side of the photos that the spheres are fitted to [px]."""
_ROUGH, _FINE = 0.4, 0.75
"""Shares of the iterations for the search for a body on the ground and for the fit inside a box."""
_GRID_SPHERES, _OTHER_SPHERES = 2000, 1500
"""Maximum number of spheres in the grid and elsewhere; fewer where the settings allow a body or a background fewer."""
_START_OPACITY = 0.1
_OPACITY_WEIGHT = 0.002
"""Weight of the mean opacity of the grid's spheres, which makes spheres fade that no photo requires."""
_SCALE = 0.4
"""Scale of a sphere of the grid, in units of the grid spacing."""
_SOLID = 0.15
"""Opacity above which a sphere of the grid counts as part of an object."""
_HALFWAY = 0.5
"""In the search on the ground it also has to be above this share of the way from the start to the most opaque sphere:
the more steps, the more opaque become also spheres that only few photos require, and they join objects to each other.
"""
_REACH = 1.8
"""Distance below which two spheres touch, in units of the sum of their scales."""
_SEARCHED = 0.6
"""Radius of the search space for bodies, in units of the distance between the cameras and their common focus."""
_MARGIN = 1.2
"""Margin around a cluster in which it is fitted again, in units of the first grid's spacing."""
_FAINT = 0.15
"""Minimum number of pixels of a cluster, as a share of those of the largest; smaller clusters are ignored."""
LEAST_SHARE = 5e-4
"""Minimum mean share of a photo that a body fills."""
_CENTRAL = 0.35
"""Standard deviation of the Gaussian weight of pixels around the middle of a photo, in units of its longer side."""


@dataclass(frozen=True)
class Region:
    """A box that is searched for a body."""

    axes: Array
    """Unit vectors along the sides of the box, world frame, one per row, shape (3, 3)."""
    low: Array
    """Lower bounds along these axes [m], shape (3,)."""
    high: Array
    """Upper bounds along these axes [m], shape (3,)."""

    def corners(self) -> Array:
        """Return the corners [m], world frame, shape (8, 3)."""
        sides = np.stack(np.meshgrid(*np.stack([self.low, self.high], 1), indexing="ij"), -1)
        return sides.reshape(-1, 3) @ self.axes

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (n, 3) lies inside, shape (n,)."""
        local = points @ self.axes.T
        return np.asarray(((local >= self.low) & (local <= self.high)).all(1))


class ObjectSearch:
    """The photos of a scene at a small size, and the fits of spheres to them.

    Args:
        capture: The capture, for messages.
        views: The photos; they are reduced here.
        ground: The ground, or None.
        points: Sparse points, world frame, (n, 3), or None.
        config: Settings of the stage.
    """

    def __init__(
        self, capture: Capture, views: Sequence[View], ground: Ground | None, points: Array | None, config: SplatConfig
    ) -> None:
        self._views = [_reduced(view) for view in views]
        self._root, self._ground, self._points, self._config = capture.root, ground, points, config
        self._up = np.array([0.0, 0.0, 1.0]) if ground is None else np.array(ground.normal)

    def standing(self, body: Body, taken: Sequence[Region]) -> tuple[Region, int]:
        """Return the region of the object on the ground that is most in view, and the number of such objects.

        Args:
            body: The body to find.
            taken: Boxes of other bodies.

        Raises:
            InputDataError: If no object is found on the ground, or only objects that extend beyond the searched space.
        """
        middle = focus_of(self._views)
        reach = _SEARCHED * float(np.median([np.linalg.norm(view.camera.center - middle) for view in self._views]))
        axes = upright_axes(self._up)
        space = Region(axes, axes @ middle - reach, axes @ middle + reach)
        spheres, count, pitch = self._fitted([space], _ROUGH, f"{body.name}: search")
        clusters = [
            members
            for members in self._clusters(spheres, count, pitch, _HALFWAY)
            if not any(region.contains(spheres.means[members].numpy().mean(0, keepdims=True))[0] for region in taken)
        ]
        weights = self._in_view(spheres, clusters)
        most = max(weights, default=0.0)
        if most < LEAST_SHARE:
            raise InputDataError(
                f"{self._root}: body '{body.name}' has neither masks nor a shape, and no object on the ground was "
                f"found within {reach:.2g} m of where the cameras look.",
                "a free-standing object on the ground, photographed from all sides.",
                "give the body a photo_box in capture.toml, or masks/.",
            )
        local = spheres.means[clusters[weights.index(most)]].numpy() @ axes.T
        low, high = local.min(0), local.max(0)
        if (low[:2] < space.low[:2] + 0.5 * pitch).any() or (high > space.high - 0.5 * pitch).any():
            raise InputDataError(
                f"{self._root}: body '{body.name}' has neither masks nor a shape, and the object most in view above "
                f"the ground extends farther than {reach:.2g} m from where the cameras look, so it is no single body.",
                "a free-standing object on the ground, photographed from all sides.",
                "give the body a photo_box in capture.toml, or masks/.",
            )
        region = Region(axes, low - _MARGIN * pitch, high + _MARGIN * pitch)
        return region, sum(weight > _FAINT * most for weight in weights)

    def contents(self, regions: dict[str, Region]) -> tuple[Spheres, float, list[tuple[NDArray[np.int64], int]]]:
        """Fit the content of the regions of bodies with a fine grid.

        Returns:
            All spheres, the spacing of the grid [m], and for each body the indices of its spheres and the number of
            objects it was chosen from.

        Raises:
            InputDataError: If a region is empty.
        """
        for name, region in regions.items():
            if self._volume(region) <= 0:
                raise self.empty(name, region)
        spheres, count, pitch = self._fitted(list(regions.values()), _FINE, "bodies: separating")
        found = []
        for name, region in regions.items():
            inside = region.contains(spheres.means.numpy())
            clusters = [members[inside[members]] for members in self._clusters(spheres, count, pitch)]
            clusters = [members for members in clusters if len(members)]
            weights = self._in_view(spheres, clusters)
            if max(weights, default=0.0) < LEAST_SHARE:
                raise self.empty(name, region)
            near = [members for members, w in zip(clusters, weights, strict=True) if w > _FAINT * max(weights)]
            found.append((np.concatenate(near), len(near)))
        return spheres, pitch, found

    def empty(self, name: str, region: Region) -> InputDataError:
        """Return the error for a region in which nothing was found."""
        return InputDataError(
            f"{self._root}: the photos show nothing solid where body '{name}' is looked for, "
            f"from {np.round(region.low, 3).tolist()} to {np.round(region.high, 3).tolist()}.",
            "a box, in the frame and unit of cameras.json, that holds the body and reaches above the ground.",
            "correct photo_box in capture.toml, or add masks/.",
        )

    def _fitted(self, regions: Sequence[Region], share: float, what: str) -> tuple[Spheres, int, float]:
        """Fit the scene; return the spheres, the number of grid spheres (the first ones), and the grid spacing [m]."""
        seed, steps = self._config.seed, max(1, round(share * self._config.iterations))
        rng = np.random.default_rng(seed)
        count = min(_GRID_SPHERES, self._config.max_body_spheres)
        volume = sum(self._volume(region) for region in regions)
        pitch = (volume / count) ** (1 / 3)
        seeds = np.concatenate([self._grid(region, pitch, rng) for region in regions])
        others = min(_OTHER_SPHERES, self._config.max_scene_spheres)
        centers, scales = scene_seeds(self._views, self._ground, self._points, others, seed)
        device = self._views[0].image.device
        grid = to_spheres(seeds, np.full(len(seeds), _SCALE * pitch), _START_OPACITY, device)
        start = Spheres.joined([grid, to_spheres(centers, scales, 0.9, device)])
        start = replace(start, colors=mean_colors(start, self._views))
        trainable = Trainable(start, Rates(means=0.05, log_scales=0.02, logits=0.06, colors=0.02))
        photometric = scene_loss(None, Exposures(self._views, False))

        def loss(spheres: Spheres, view: View, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            faint = spheres.opacities[: len(seeds)].sum() / count
            value, wrong = photometric(spheres, view, generator)
            return value + _OPACITY_WEIGHT * faint, wrong

        descend(trainable, self._views, loss, steps, seed, what)
        fitted = trainable.spheres()
        parts = (fitted.means, fitted.scales, fitted.opacities, fitted.colors)
        return Spheres(*(part.detach().cpu() for part in parts)), len(seeds), pitch

    def _volume(self, region: Region) -> float:
        """Return the volume of a region above the ground [m3], by sampling."""
        sides = region.high - region.low
        samples = (region.low + sides * np.random.default_rng(0).random((4000, 3))) @ region.axes
        return float(sides.prod() * (self._height(samples) > 0).mean())

    def _grid(self, region: Region, pitch: float, rng: np.random.Generator) -> Array:
        """Return points of a region above the ground with a spacing of about `pitch` [m], world frame, (n, 3)."""
        ticks = [np.arange(a + 0.5 * pitch, b, pitch) for a, b in zip(region.low, region.high, strict=True)]
        local = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3)
        points = (local + rng.uniform(-0.3, 0.3, local.shape) * pitch) @ region.axes
        return points[self._height(points) > 0]

    def _height(self, points: Array) -> Array:
        """Return the height of points (n, 3) above the ground [m]; infinite without a ground."""
        if self._ground is None:
            return np.full(len(points), np.inf)
        return points @ self._up - self._ground.offset_m

    def _clusters(self, spheres: Spheres, count: int, pitch: float, share: float = 0.0) -> list[NDArray[np.int64]]:
        """Return the connected clusters of the grid's spheres that are solid and clear of the ground.

        Solid is what is at least so far on the way from the start to the most opaque sphere, as a share.
        """
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components  # dear to import, and seldom needed

        means, scales = spheres.means.numpy(), spheres.scales.numpy()
        opacities = spheres.opacities[:count].numpy()
        least = max(_SOLID, _START_OPACITY + share * (float(opacities.max(initial=0.0)) - _START_OPACITY))
        solid = (opacities > least) & (self._height(means[:count]) > 0.2 * pitch)
        chosen = np.flatnonzero(solid)
        if len(chosen) == 0:
            return []
        reach = 2 * _REACH * float(scales[chosen].max())
        pairs = KDTree(means[chosen]).query_pairs(reach, output_type="ndarray")
        a, b = chosen[pairs[:, 0]], chosen[pairs[:, 1]]
        touch = np.linalg.norm(means[a] - means[b], axis=1) < _REACH * (scales[a] + scales[b])
        pairs = pairs[touch]
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(chosen), len(chosen)))
        _, label = connected_components(graph, directed=False)
        return [chosen[label == k] for k in range(int(label.max()) + 1)]

    @torch.no_grad()
    def _in_view(self, spheres: Spheres, clusters: Sequence[NDArray[np.int64]]) -> list[float]:
        """Return the weighted number of unlabelled pixels that each cluster fills, as a mean share of a photo.

        Pixels in the middle of a photo have the largest weight.
        """
        if not clusters:
            return []
        label = torch.zeros(len(spheres), len(clusters))
        for k, members in enumerate(clusters):
            label[members, k] = 1.0
        labelled = replace(spheres, colors=label)
        total = torch.zeros(len(clusters))
        pixels = 0.0
        for view in self._views:
            width, height = view.size
            v, u = torch.meshgrid(torch.arange(height) - height / 2, torch.arange(width) - width / 2, indexing="ij")
            central = torch.exp(-0.5 * (u**2 + v**2) / (_CENTRAL * max(width, height)) ** 2)
            pixels += float(central.sum())
            if view.cover is not None:
                central = central * (1 - view.cover.sum(0).cpu())
            seen = render_view(labelled, replace(view, viewmat=view.viewmat.cpu(), K=view.K.cpu())).features[0]
            total += (seen * central[..., None]).sum((0, 1))
        return (total / pixels).tolist()


def _reduced(view: View) -> View:
    """Return a view at the reduced size of the fit of spheres."""
    width, height = view.size
    scale = min(1.0, _SIZE / max(width, height))
    size = round(scale * height), round(scale * width)
    images = [view.image.permute(2, 0, 1), *([] if view.cover is None else [view.cover])]
    image, *cover = (functional.interpolate(one[None], size=size, mode="area")[0] for one in images)
    K = torch.diag(torch.tensor([size[1] / width, size[0] / height, 1.0])).to(view.K) @ view.K
    seen = None
    if view.seen is not None:
        seen = functional.interpolate(view.seen[None, None].float(), size=size, mode="area")[0, 0] > 0.999
    cover_now = cover[0] if cover else None
    return replace(view, image=image.permute(1, 2, 0).contiguous(), cover=cover_now, seen=seen, K=K)
