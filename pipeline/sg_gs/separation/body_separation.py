"""Separation of bodies from a scene without masks: by a box, by the ground and clustering, or by a plain background.

An object is searched for on the ground (`object_search`), and a finer grid of spheres is fitted around it alone; a box
in the manifest replaces the search. The result locates a body to about the spacing of the grid; `mask_segmentation`
then finds its border in every photo.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ....datasets.capture.capture import Capture
from ....schemas import Body, Ground, InputDataError, PhotoBox, SplatConfig
from ...geometry.solid_grid import Array
from ..photos.views import COVERED, View
from .mask_segmentation import Blob, Outlined, outline, outline_before_plain
from .object_search import LEAST_SHARE, ObjectSearch, Region

_POOR = 0.9
"""Agreement of the masks below which a warning asks the user to check the picture."""


_Method = Literal["box", "ground", "plain"]


@dataclass(frozen=True)
class BodyRecord:
    """How one body was separated."""

    method: _Method
    """How the body was found: by the box in the manifest, by the ground, or before a plain background."""
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
    wanted = _without_masks(bodies, train)
    if not wanted:
        return None
    if len(wanted) == 1 and ground is None and bodies[wanted[0]].photo_box is None:
        plain = outline_before_plain(capture, train, test, wanted[0])
        if plain is not None:
            return _separation(plain, {bodies[wanted[0]].name: "plain"}, {})
    _refuse_the_unknowable(capture, [bodies[index] for index in wanted], ground)
    search = ObjectSearch(capture, train, ground, points, config)
    boxes = {index: _region(box) for index in wanted if (box := bodies[index].photo_box) is not None}
    regions, counts = _regions(search, bodies, wanted, boxes)
    spheres, pitch, parts = search.contents({bodies[index].name: regions[index] for index in wanted})
    blobs = [
        Blob(index, part, boxes[index].corners() if index in boxes else None)
        for index, (part, _) in zip(wanted, parts, strict=True)
    ]
    outlined = outline(capture, train, test, spheres, pitch, blobs, ground)
    for index, share in zip(wanted, outlined.shares, strict=True):
        if share < LEAST_SHARE:
            raise search.empty(bodies[index].name, regions[index])
    methods: dict[str, _Method] = {bodies[index].name: "box" if index in boxes else "ground" for index in wanted}
    found = zip(wanted, parts, strict=True)
    return _separation(outlined, methods, {bodies[k].name: counts.get(k, count) for k, (_, count) in found})


def _separation(outlined: Outlined, methods: Mapping[str, _Method], counts: Mapping[str, int]) -> Separation:
    figures = zip(methods.items(), outlined.shares, outlined.agreements, strict=True)
    entries = {
        name: BodyRecord(method, counts.get(name, 1), round(share, 4), round(agreement, 4))
        for (name, method), share, agreement in figures
    }
    record = {name: asdict(entry) for name, entry in entries.items()}
    warnings = tuple(text for name, entry in entries.items() for text in _remarks(name, entry))
    return Separation(outlined.train, outlined.test, record, warnings)


def _regions(
    search: ObjectSearch, bodies: Sequence[Body], wanted: Sequence[int], boxes: Mapping[int, Region]
) -> tuple[dict[int, Region], dict[int, int]]:
    """Return where each wanted body is, and from how many objects on the ground those without a box were chosen."""
    regions, counts = dict(boxes), {}
    for index in wanted:
        if index not in boxes:
            regions[index], counts[index] = search.standing(bodies[index], list(boxes.values()))
    return regions, counts


def _without_masks(bodies: Sequence[Body], views: Sequence[View]) -> list[int]:
    """Return the indices of the bodies that no mask shows and that a box or the ground is to separate."""
    return [index for index, body in enumerate(bodies) if _wants(body, index, views)] if views else []


def _wants(body: Body, index: int, views: Sequence[View]) -> bool:
    if body.shape is not None and body.photo_box is None:
        return False
    return not any(view.cover is not None and bool((view.cover[index] > COVERED).any()) for view in views)


def _refuse_the_unknowable(capture: Capture, bodies: Sequence[Body], ground: Ground | None) -> None:
    boxless = [body.name for body in bodies if body.photo_box is None]
    unit = "m" if capture.cameras is not None and capture.cameras.scale.kind == "metric" else "in the cameras' unit"
    todo = f"give each a photo_box = {{ min_m = [x, y, z], max_m = [x, y, z] }} ({unit}, world frame) in capture.toml."
    if boxless and ground is None:
        raise InputDataError(
            f"{capture.root}: body '{boxless[0]}' has neither a shape nor masks, and can be found neither by a box nor "
            "by the ground.",
            "masks/ with its label, a shape, a photo_box, a plain background, or, with metric cameras, a ground.",
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
    where = {"box": "in its box", "ground": "on the ground", "plain": "before the plain background"}[entry.method]
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


def _region(box: PhotoBox) -> Region:
    return Region(np.eye(3), np.array(box.min_m), np.array(box.max_m))
