"""What has to be refused of fixed surfaces, materials and forces of a capture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .edits import FIT, Edit, Row, field, text

MANIFEST = "capture/capture.toml"
TRACK = "capture/tracks/000.csv"
SHEET = '{ name = "sheet", rectangle = { half_extents_m = [1.0, 1.0] } }'
STEEL = '[{ name = "steel" }, { name = "wood" }]'
CLOSED_BOX = (
    [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
     (1, 5, 7), (1, 7, 3)],
)  # fmt: skip


def rows() -> Iterator[Row]:
    """Yield the table: each line for `validate` and for `fit`."""
    for name, edit in (*SURFACES, *MATERIALS, *FORCES):
        yield Row(f"{name}: validate", "surfaces", "tosses", edit, ("validate", "capture"))
        yield Row(f"{name}: fit", "surfaces", "tosses", edit, FIT)
    for name, edit in UNFIT:
        yield Row(f"{name}: fit", "surfaces", "tosses", edit, FIT)


def _all(*edits: Edit) -> Edit:
    def edit(root: Path) -> None:
        for one in edits:
            one(root)

    return edit


def _surfaces(*entries: str) -> Edit:
    return field(MANIFEST, "surfaces", f"[{', '.join(entries)}]")


def _mesh(factor: float = 0.5, leave_out: int = 0, inside: str = ', inside = "closed"', flat: bool = False) -> Edit:
    """Add a box as a mesh of some size [m], without some triangles, or with a triangle that has no area."""
    entry = f'{{ name = "tray", mesh = {{ path = "tray.obj"{inside} }}, pose = {{ position_m = [0.0, 0.0, -9.0] }} }}'

    def edit(root: Path) -> None:
        corners, faces = CLOSED_BOX
        listed = [(0, 1, 8), *faces] if flat else faces[leave_out:]  # the last corner is between the first two
        lines = [f"v {factor * x} {factor * y} {factor * z}" for x, y, z in (*corners, (-1, -1, 0))]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in listed]
        (root / "capture/tray.obj").write_text("\n".join(lines) + "\n")
        _surfaces(entry)(root)

    return edit


def _heights(values: object, size: str = "[1.0, 1.0]") -> Edit:
    entry = f'{{ name = "hills", height_field = {{ path = "hills.npy", size_m = {size} }} }}'

    def edit(root: Path) -> None:
        np.save(root / "capture/hills.npy", np.asarray(values))
        _surfaces(entry)(root)

    return edit


SURFACES: tuple[tuple[str, Edit], ...] = (
    ("a surface that is not watertight where it is solid", _mesh(leave_out=1)),
    ("a surface with a degenerate triangle", _mesh(flat=True, inside="")),
    ("a surface in mm", _mesh(factor=500.0)),
    ("a surface without its file", _surfaces('{ name = "tray", mesh = { path = "tray.obj" } }')),
    ("a surface outside of the capture", _surfaces('{ name = "tray", mesh = { path = "../tray.obj" } }')),
    ("heights that are not finite", _heights([[0.0, np.nan], [0.0, 0.0]])),
    ("heights in a row", _heights([0.0, 1.0, 2.0])),
    ("heights of objects", _heights(np.array([["a", "b"], ["c", "d"]]))),
    ("heights on an area of zero", _heights([[0.0, 0.0], [0.0, 0.0]], "[0.0, 1.0]")),
    ("two surfaces of one name", _surfaces(SHEET, SHEET)),
    ("a surface with the name of a body", _surfaces(SHEET.replace('"sheet"', '"box"'))),
    ("a surface of two shapes", _surfaces(SHEET[:-1] + ", half_space = {} }")),
    ("a surface without a shape", _surfaces('{ name = "sheet" }')),
    ("a surface of a negative size", _surfaces(SHEET.replace("1.0, 1.0", "-1.0, 1.0"))),
    ("a surface of infinite size", _surfaces(SHEET.replace("1.0, 1.0", "inf, 1.0"))),
    ("a surface whose quaternion is zero", _surfaces(SHEET[:-1] + ", pose = { quat_wxyz = [0.0, 0.0, 0.0, 0.0] } }")),
    ("a surface of a material that nobody knows", _surfaces(SHEET[:-1] + ', material = "felt" }')),
)

MATERIALS: tuple[tuple[str, Edit], ...] = (
    ("a material that nobody knows", field(MANIFEST, "bodies 0 material", '"felt"')),
    ("two materials of one name", field(MANIFEST, "materials", '[{ name = "steel" }, { name = "steel" }]')),
    ("a pair of a material that nobody knows", _all(
        field(MANIFEST, "materials", STEEL),
        field(MANIFEST, "pairs", '[{ materials = ["steel", "felt"], friction = 0.3 }]'))),
    ("a pair twice, in both orders", _all(
        field(MANIFEST, "materials", STEEL),
        field(MANIFEST, "pairs", '[{ materials = ["steel", "wood"], friction = 0.3 }, '
                                 '{ materials = ["wood", "steel"], friction = 0.3 }]'))),
    ("a pair of three materials", _all(
        field(MANIFEST, "materials", STEEL),
        field(MANIFEST, "pairs", '[{ materials = ["steel", "wood", "wood"], friction = 0.3 }]'))),
    ("a negative friction of a pair", _all(
        field(MANIFEST, "materials", STEEL),
        field(MANIFEST, "pairs", '[{ materials = ["steel", "wood"], friction = -0.3 }]'))),
    ("a friction that is not finite", field(MANIFEST, "materials", '[{ name = "steel", friction = inf }]')),
)  # fmt: skip


def _forces(root: Path) -> None:
    """Give a free body a measured force."""
    path = root / TRACK
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header + ",force_x_n,force_y_n,force_z_n", *(f"{line},0,0,1" for line in lines)]) + "\n")


FORCES: tuple[tuple[str, Edit], ...] = (
    ("a measured force of a free body", _forces),
    ("a force without its z", _all(_forces, text(TRACK, ",force_z_n", ",force_w_n"))),
)

_NOBODY_KNOWS = _all(
    field(MANIFEST, "bodies", '[{ name = "box", mass_kg = 0.37, material = "steel", shape = { box = '
          '{ half_extents_m = [0.05, 0.05, 0.05] } } }, { name = "other", mass_kg = 0.37, material = "wood", '
          'shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } } }]'),
    field(MANIFEST, "materials", STEEL),
)  # fmt: skip
UNFIT: tuple[tuple[str, Edit], ...] = (
    ("a pair that nobody gave and no episode shows", _NOBODY_KNOWS),
    ("bodies that begin inside a surface", _surfaces('{ name = "slab", box = { half_extents_m = [9.0, 9.0, 9.0] } }')),
)
