"""Separation of bodies from a scene without masks: by a box in the manifest, or by the ground and clustering.

Spheres are fitted to all photos at a small size: some on the ground and far away, others on a grid in the space where a
body may be. The spheres of the grid start nearly transparent and become opaque where the photos require it. The opaque
spheres above the ground are clustered, and a finer grid is fitted around the chosen cluster alone; a box in the
manifest replaces this first step. The result locates a body to about the spacing of the grid; `mask_segmentation` then
finds its border in every photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from ...datasets.capture.capture import Capture
from ...schemas import Body, Ground, InputDataError, PhotoBox, SplatConfig
from ..geometry.directions import upright_axes
from ..geometry.solid_grid import Array
from ..geometry.spheres import Spheres
from .colors import mean_colors
from .initialization import scene_seeds, to_spheres
from .losses import scene_loss
from .mask_segmentation import Blob, outline
from .optimize import Rates, Trainable, descend
from .photo_exposure import Exposures
from .views import View, focus_of, render_view

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
_REACH = 1.8
"""Distance below which two spheres touch, in units of the sum of their scales."""
_SEARCHED = 0.6
"""Radius of the search space for bodies, in units of the distance between the cameras and their common focus."""
_MARGIN = 1.2
"""Margin around a cluster in which it is fitted again, in units of the first grid's spacing."""
_FAINT = 0.15
"""Minimum number of pixels of a cluster, as a share of those of the largest; smaller clusters are ignored."""
_LEAST = 5e-4
"""Minimum mean share of a photo that a body fills."""
_CENTRAL = 0.35
"""Standard deviation of the Gaussian weight of pixels around the middle of a photo, in units of its longer side."""
_POOR = 0.9
"""Agreement of the masks below which a warning asks the user to check the picture."""


@dataclass(frozen=True)
class BodyRecord:
    """How one body was separated."""

    method: Literal["box", "ground"]
    """How the body was found: by the box in the manifest, or by the ground and clustering."""
    clusters: int
    """Number of objects found on the ground, or in the box."""
    share: float
    """Mean share of the pixels of a photo that the body fills."""
    agreement: float
    """Mean IoU of the masks and the projections of the solid that is carved by all of them."""


@dataclass(frozen=True)
class Separation:
    """Photos with masks of bodies that had none."""

    train: list[View]
    """The photos to fit, with masks."""
    test: list[View]
    """The held-out photos, with masks; they were not used to find the bodies."""
    record: dict[str, dict[str, Any]]
    """`BodyRecord` by body, for fit.json."""
    warnings: tuple[str, ...]
    """Messages for the user."""


def separate(
    capture: Capture,
    train: Sequence[View],
    test: Sequence[View],
    ground: Ground | None,
    points: Array | None,
    config: SplatConfig,
) -> Separation | None:
    """Segment the bodies without masks that have a box or no shape, and add their masks to the photos.

    Args:
        capture: The capture.
        train: The photos to fit.
        test: The photos that are held out.
        ground: The ground, where there is one and its place among the photos is known.
        points: Sparse points of the calibration, world frame, (n, 3), or None.
        config: Settings of the stage.

    Returns:
        The photos with masks, or None if no body needs masks or the capture has no photos.

    Raises:
        InputDataError: If a body can be found neither by a box nor by the ground, or nothing is found.
    """
    bodies = capture.manifest.bodies
    wanted = [index for index, body in enumerate(bodies) if _wants(body, index, train)] if train else []
    if not wanted:
        return None
    _refuse_the_unknowable(capture, [bodies[index] for index in wanted], ground)
    small = [_small(view) for view in train]
    scene = _Scene(capture, small, ground, points, config)
    boxes = {index: _region(box) for index in wanted if (box := bodies[index].photo_box) is not None}
    regions, counts = dict(boxes), {}
    for index in wanted:
        if index not in boxes:
            regions[index], counts[index] = scene.standing(bodies[index], list(boxes.values()))
    spheres, pitch, parts = scene.contents({bodies[index].name: regions[index] for index in wanted})
    blobs = [
        Blob(index, part, boxes[index].corners() if index in boxes else None)
        for index, (part, _) in zip(wanted, parts, strict=True)
    ]
    outlined = outline(capture, train, test, spheres, pitch, blobs, ground)
    record: dict[str, dict[str, Any]] = {}
    warnings: list[str] = []
    for index, (_, count), share, agreement in zip(wanted, parts, outlined.shares, outlined.agreements, strict=True):
        if share < _LEAST:
            raise scene.empty(bodies[index].name, regions[index])
        entry = BodyRecord(
            "box" if index in boxes else "ground", counts.get(index, count), round(share, 4), round(agreement, 4)
        )
        record[bodies[index].name] = asdict(entry)
        warnings += _remarks(bodies[index].name, entry)
    return Separation(outlined.train, outlined.test, record, tuple(warnings))


def _wants(body: Body, index: int, views: Sequence[View]) -> bool:
    if body.shape is not None and body.photo_box is None:
        return False
    return not any(view.cover is not None and bool((view.cover[index] > 0.5).any()) for view in views)


def _refuse_the_unknowable(capture: Capture, bodies: Sequence[Body], ground: Ground | None) -> None:
    boxless = [body.name for body in bodies if body.photo_box is None]
    unit = "m" if capture.cameras is not None and capture.cameras.scale.kind == "metric" else "in the cameras' unit"
    todo = f"give each a photo_box = {{ min_m = [x, y, z], max_m = [x, y, z] }} ({unit}, world frame) in capture.toml."
    if boxless and ground is None:
        raise InputDataError(
            f"{capture.root}: body '{boxless[0]}' has neither a shape nor masks, and can be found neither by a box nor "
            "by the ground.",
            "masks/ with its label, a shape, a photo_box, or (with metric cameras) a ground below it.",
            todo,
        )
    if len(boxless) > 1:
        raise InputDataError(
            f"{capture.root}: bodies {', '.join(repr(name) for name in boxless)} have neither masks, shapes nor boxes, "
            "so they cannot be distinguished.",
            "one such body.",
            todo,
        )


def _remarks(name: str, entry: BodyRecord) -> list[str]:
    where = "in its box" if entry.method == "box" else "on the ground"
    remarks = [
        f"body '{name}' has no masks: it was separated by what is {where}. separation.png shows the result; the "
        "held-out figures within the mask depend on it."
    ]
    if entry.method == "ground" and entry.clusters > 1:
        remarks.append(
            f"body '{name}': {entry.clusters} objects were found on the ground, and the one most in view was "
            "chosen. To choose another, set photo_box in capture.toml."
        )
    if entry.agreement < _POOR:
        remarks.append(
            f"body '{name}': its masks agree with each other by {entry.agreement:.2f} only (IoU with the solid carved "
            f"by them; {_POOR:g} or more is good). Check separation.png; masks/ or a tighter photo_box would help."
        )
    return remarks


@dataclass(frozen=True)
class _Region:
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


def _region(box: PhotoBox) -> _Region:
    return _Region(np.eye(3), np.array(box.min_m), np.array(box.max_m))


class _Scene:
    """The reduced photos of a scene and the fits of spheres to them.

    Args:
        capture: The capture, for messages.
        views: The reduced photos.
        ground: The ground, or None.
        points: Sparse points, world frame, (n, 3), or None.
        config: Settings of the stage.
    """

    def __init__(
        self, capture: Capture, views: Sequence[View], ground: Ground | None, points: Array | None, config: SplatConfig
    ) -> None:
        self._root, self._views, self._ground, self._points = capture.root, views, ground, points
        self._config = config
        self._up = np.array([0.0, 0.0, 1.0]) if ground is None else np.array(ground.normal)

    def standing(self, body: Body, taken: Sequence[_Region]) -> tuple[_Region, int]:
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
        space = _Region(axes, axes @ middle - reach, axes @ middle + reach)
        spheres, count, pitch = self._fitted([space], _ROUGH, f"{body.name}: search")
        clusters = [
            members
            for members in self._clusters(spheres, count, pitch)
            if not any(region.contains(spheres.means[members].numpy().mean(0, keepdims=True))[0] for region in taken)
        ]
        weights = self._in_view(spheres, clusters)
        most = max(weights, default=0.0)
        if most < _LEAST:
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
        region = _Region(axes, low - _MARGIN * pitch, high + _MARGIN * pitch)
        return region, sum(weight > _FAINT * most for weight in weights)

    def contents(self, regions: dict[str, _Region]) -> tuple[Spheres, float, list[tuple[NDArray[np.int64], int]]]:
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
            if max(weights, default=0.0) < _LEAST:
                raise self.empty(name, region)
            near = [members for members, w in zip(clusters, weights, strict=True) if w > _FAINT * max(weights)]
            found.append((np.concatenate(near), len(near)))
        return spheres, pitch, found

    def empty(self, name: str, region: _Region) -> InputDataError:
        """Return the error for a region in which nothing was found."""
        return InputDataError(
            f"{self._root}: the photos show nothing solid where body '{name}' is looked for, "
            f"from {np.round(region.low, 3).tolist()} to {np.round(region.high, 3).tolist()}.",
            "a box, in the frame and unit of cameras.json, that holds the body and reaches above the ground.",
            "correct photo_box in capture.toml, or add masks/.",
        )

    def _fitted(self, regions: Sequence[_Region], share: float, what: str) -> tuple[Spheres, int, float]:
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

    def _volume(self, region: _Region) -> float:
        """Return the volume of a region above the ground [m3], by sampling."""
        sides = region.high - region.low
        samples = (region.low + sides * np.random.default_rng(0).random((4000, 3))) @ region.axes
        return float(sides.prod() * (self._height(samples) > 0).mean())

    def _grid(self, region: _Region, pitch: float, rng: np.random.Generator) -> Array:
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

    def _clusters(self, spheres: Spheres, count: int, pitch: float) -> list[NDArray[np.int64]]:
        """Return the connected clusters of the grid's spheres that are solid and clear of the ground."""
        means, scales = spheres.means.numpy(), spheres.scales.numpy()
        solid = (spheres.opacities[:count].numpy() > _SOLID) & (self._height(means[:count]) > 0.2 * pitch)
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


def _small(view: View) -> View:
    """Return a view at the reduced size of the fit of spheres."""
    width, height = view.size
    scale = min(1.0, _SIZE / max(width, height))
    size = round(scale * height), round(scale * width)
    images = [view.image.permute(2, 0, 1), *([] if view.cover is None else [view.cover])]
    image, *cover = (functional.interpolate(one[None], size=size, mode="area")[0] for one in images)
    K = torch.diag(torch.tensor([size[1] / width, size[0] / height, 1.0])).to(view.K) @ view.K
    return replace(view, image=image.permute(1, 2, 0).contiguous(), cover=cover[0] if cover else None, K=K)
