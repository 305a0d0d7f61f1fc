"""Spherical Gaussians in the .ply layout of 3D Gaussian splatting (INRIA), so that the usual viewers open them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.distinct import first_repeated
from ...schemas.regular_files import read_binary_file
from ..io.atomic import new_file

Array = NDArray[np.floating]

SH_C0 = 0.28209479177387814
"""Constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 f_dc."""

MOST_BYTES = 16 << 30
"""Largest size of a file [bytes]; of a splat with all harmonics, 248 bytes."""
_AGAIN = "write it again, or take the original."
_REMOVE = "remove these splats, or write it again."
_HEADER = (
    "format ascii or binary_little_endian 1.0, then 'element vertex <count>' with 'property <type> <name>' lines, each "
    "name once."
)
_OPACITY_MARGIN = 1e-6
_HIGHER_TERMS = (3, 8, 15)
"""Harmonics from degree 1 up to degree 1, 2 and 3."""
_ISOTROPY_TOLERANCE = 0.01
_MOST_LOG_SCALE = 80.0
"""Largest magnitude of the logarithm of a scale, far beyond every size in metres, at which its exponential is finite in
float32."""
_PLY_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "char": "i1", "int8": "i1"}
_PLY_TYPES |= {"uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"}
_PLY_TYPES |= {"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}
_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")


@dataclass(frozen=True, eq=False)
class Splats:
    """Spherical Gaussians; isotropic and of one colour from all sides, so that turning a body turns them exactly."""

    means: Array
    """Centres [m], shape (N, 3), in the frame of the body or of the world."""
    scales: Array
    """Standard deviations s [m], shape (N,), not their logarithms."""
    opacities: Array
    """Peak opacities in (0, 1), shape (N,)."""
    colors: Array
    """sRGB values as stored in images, in [0, 1], shape (N, 3)."""
    normals: Array | None = None
    """Outward unit normals of the surface that the spheres show, in the frame of `means`, shape (N, 3), or None where
    they are not known.
    """
    harmonics: Array | None = None
    """Coefficients of the spherical harmonics of degree 1 to 3 that add to the
    colours, 3DGS's signs, shape (N, K, 3) with K = 3, 8 or 15; None: the same from all sides.
    """

    def __post_init__(self) -> None:
        count = len(self.means)
        if self.normals is not None and self.normals.shape != (count, 3):
            raise ValueError(f"normals must be ({count}, 3); found {self.normals.shape}")
        if self.harmonics is not None and self.harmonics.shape not in [(count, terms, 3) for terms in _HIGHER_TERMS]:
            raise ValueError(f"harmonics must be ({count}, 3, 8 or 15, 3); found {self.harmonics.shape}")
        shapes = (self.means.shape, self.scales.shape, self.opacities.shape, self.colors.shape)
        if shapes != ((count, 3), (count,), (count,), (count, 3)):
            raise ValueError(f"means, scales, opacities, colors must be (N,3), (N,), (N,), (N,3); found {shapes}")

    def __len__(self) -> int:
        return len(self.means)

    def reach_m(self, radius_factor: float, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> float:
        """Return how far spheres with radii of so many standard deviations reach from a point of their frame [m]."""
        distance = np.linalg.norm(np.asarray(self.means, float) - origin, axis=1)
        return float((distance + np.asarray(self.scales, float) * radius_factor).max())


def write_splats(
    path: Path | str,
    splats: Splats,
    frame: Literal["body", "world"] = "body",
    sh_degree: int = 0,
    overwrite: bool = False,
) -> None:
    """Write spheres as a binary .ply: opacity as logit, log scale three times, unit quaternion, unknown normals as 0.

    Args:
        path: The file.
        splats: The spheres.
        frame: The frame of the centres; it stands in a comment of the header.
        sh_degree: Pad the colours with zeros up to this degree, if they have less; INRIA's own loader wants 3.
        overwrite: Replace an existing file.
    """
    names, table = _table(splats, sh_degree)
    if not np.isfinite(table).all():
        raise ValueError("spheres with values that are not finite, or with a scale of 0, cannot be written")
    header = ["ply", "format binary_little_endian 1.0", "comment unit metre", f"comment frame {frame}"]
    header += [f"element vertex {len(splats)}", *(f"property float {name}" for name in names), "end_header"]
    with new_file(path, "splat file", overwrite) as temporary:
        temporary.write_bytes(("\n".join(header) + "\n").encode("ascii") + table.tobytes())


def _table(splats: Splats, sh_degree: int) -> tuple[list[str], NDArray[np.float32]]:
    """Return the names of the properties of a file, and their values (N, P); see `write_splats`."""
    higher = np.zeros((len(splats), 0, 3)) if splats.harmonics is None else np.asarray(splats.harmonics)
    terms = max((sh_degree + 1) ** 2 - 1, higher.shape[1])
    rest = 3 * terms
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(rest))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    table = np.zeros((len(splats), len(names)), "<f4")
    column = {name: k for k, name in enumerate(names)}
    opacities = np.clip(np.asarray(splats.opacities, np.float64), _OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    table[:, :3] = splats.means
    if splats.normals is not None:
        table[:, 3:6] = splats.normals
    table[:, 6:9] = (np.asarray(splats.colors, np.float64) - 0.5) / SH_C0
    if rest:  # one channel after the other
        padded = np.pad(higher, ((0, 0), (0, terms - higher.shape[1]), (0, 0)))
        table[:, 9 : 9 + rest] = padded.transpose(0, 2, 1).reshape(len(splats), rest)
    table[:, column["opacity"]] = np.log(opacities / (1 - opacities))
    table[:, column["scale_0"] : column["scale_2"] + 1] = np.log(np.asarray(splats.scales, np.float64))[:, None]
    table[:, column["rot_0"]] = 1.0
    return names, table


def read_splats(path: Path | str, harmonics: bool = False) -> Splats:
    """Read spheres from a .ply of 3D Gaussian splatting.

    Args:
        path: The file.
        harmonics: Read the colours' dependence on the direction too; otherwise they are those of degree 0.

    Raises:
        InputDataError: If it is no such file, is cut off, is not in metres by its own word, holds a value that
            is not finite, or Gaussians that are no spheres (scales that differ by more than 1 %).
    """
    path = Path(path)
    columns, comments = _read_vertices(path)
    _require_metres(path, comments)
    table = _finite_columns(path, columns)
    log_scales = np.stack([table[f"scale_{k}"] for k in range(3)], axis=1)
    _require_spheres(path, log_scales)
    colors = 0.5 + SH_C0 * np.stack([table[f"f_dc_{k}"] for k in range(3)], axis=1)
    higher = _harmonics(path, columns) if harmonics else None
    return Splats(
        means=np.stack([table[axis] for axis in "xyz"], axis=1),
        scales=np.exp(log_scales.mean(axis=1)),
        opacities=1 / (1 + np.exp(-table["opacity"])),
        colors=np.clip(colors, 0.0, 1.0) if higher is None else colors,
        normals=_unit_normals(columns),
        harmonics=higher,
    )


def _require_spheres(path: Path, log_scales: Array) -> None:
    """Refuse splats whose three scales differ, or lie far beyond what can be seen."""
    uneven = int(np.count_nonzero(np.ptp(log_scales, axis=1) > _ISOTROPY_TOLERANCE))
    if uneven:
        raise InputDataError(
            f"{path}: {uneven} of {len(log_scales)} splats are no spheres.",
            "three scales that are equal within 1 %.",
            "leave the shape out, so that cgwm fit makes spheres from the photos.",
        )
    far = int(np.count_nonzero(np.abs(log_scales) > _MOST_LOG_SCALE))
    if far:
        raise InputDataError(
            f"{path}: the logarithm of a scale of {far} splats is {log_scales.flat[np.abs(log_scales).argmax()]:.4g}.",
            f"-{_MOST_LOG_SCALE:g} to {_MOST_LOG_SCALE:g}.",
            "train the splats again, or remove these.",
        )


def _require_metres(path: Path, comments: list[str]) -> None:
    unit = next((comment.split()[1] for comment in comments if comment.startswith("unit ")), "metre")
    if unit not in ("metre", "meter", "m"):
        raise InputDataError(f"{path}: its header says 'comment unit {unit}'.", "metre.", "scale the splats to metres.")


def _finite_columns(path: Path, columns: dict[str, Array]) -> dict[str, NDArray[np.float64]]:
    """Return the needed columns in float64; all of them must exist and be finite."""
    lacking = [name for name in _NEEDED if name not in columns]
    if lacking:
        raise InputDataError(
            f"{path}: no property '{lacking[0]}'; it is no 3D Gaussian splatting file.",
            "the properties " + ", ".join(_NEEDED) + ".",
            "export the splats from their training again.",
        )
    table = {name: np.asarray(columns[name], np.float64) for name in _NEEDED}
    for name, values in table.items():
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise InputDataError(
                f"{path}: '{name}' is not finite in {bad} of {len(values)} splats.", "finite numbers.", _REMOVE
            )
    return table


def _stacked(columns: Mapping[str, Array], names: Sequence[str]) -> Array:
    """Return some columns side by side, shape (N, len(names))."""
    return np.stack([np.asarray(columns[name], np.float64) for name in names], axis=1)


def _harmonics(path: Path, columns: dict[str, Array]) -> Array | None:
    """Return the harmonics from degree 1 on (N, K, 3), or None where there are none or all are zero."""
    count = sum(name.startswith("f_rest_") for name in columns)
    if count == 0:
        return None
    if count % 3 or count // 3 not in _HIGHER_TERMS or any(f"f_rest_{k}" not in columns for k in range(count)):
        raise InputDataError(
            f"{path}: {count} properties 'f_rest_*'.",
            "9, 24 or 45 of them, of degree 1, 2 or 3.",
            "export the splats with all harmonics of a degree.",
        )
    values = _stacked(columns, [f"f_rest_{k}" for k in range(count)])
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).any(1).sum())
        raise InputDataError(f"{path}: 'f_rest_*' is not finite in {bad} splats.", "finite numbers.", _REMOVE)
    return values.reshape(-1, 3, count // 3).transpose(0, 2, 1) if values.any() else None


def _unit_normals(columns: dict[str, Array]) -> Array | None:
    """Return the normals (N, 3), or None if the file has none: other programs write zeros."""
    if any(name not in columns for name in ("nx", "ny", "nz")):
        return None
    normals = _stacked(columns, ("nx", "ny", "nz"))
    length = np.linalg.norm(normals, axis=1)
    if not (np.isfinite(length) & (length > 1e-6)).all():
        return None
    return normals / length[:, None]


def _read_vertices(path: Path) -> tuple[dict[str, Array], list[str]]:
    data = read_binary_file(path, MOST_BYTES)
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputDataError(
            f"{path}: no .ply file.", "a file that begins with 'ply' and a header up to 'end_header'.", _AGAIN
        )
    body = data.find(b"\n", end) + 1
    kind, count, properties, comments = _parse_header(path, data[:end].decode("ascii", "replace"))
    if kind == "ascii":
        rows = _ascii_rows(path, data[body:], count, len(properties))
        return {name: rows[:, k] for k, (name, _) in enumerate(properties)}, comments
    order = "<" if kind == "binary_little_endian" else ">"
    dtype = np.dtype([(name, order + code) for name, code in properties])
    if len(data) - body < count * dtype.itemsize:
        raise _cut_off(path, count)
    table = np.frombuffer(data, dtype, count, body)
    return {name: table[name] for name, _ in properties}, comments


def _ascii_rows(path: Path, data: bytes, count: int, width: int) -> Array:
    """Return the numbers (count, width) of a text."""
    try:
        words = np.array(data.split()[: count * width], np.float64)
    except ValueError as error:
        raise InputDataError(f"{path}: a value that is no number: {str(error)[:80]}.", todo=_AGAIN) from None
    if len(words) < count * width:
        raise _cut_off(path, count)
    return words.reshape(count, width)


def _cut_off(path: Path, count: int) -> InputDataError:
    return InputDataError(f"{path}: cut off: it holds fewer than the {count} splats of its header.", todo=_AGAIN)


def _count(word: str) -> int:
    if not (word.isascii() and word.isdigit()):
        raise ValueError(f"{word[:40]!r} is no number of splats")
    return int(word)


def _parse_header(path: Path, text: str) -> tuple[str, int, list[tuple[str, str]], list[str]]:
    """Return the format, the number of splats, their properties (name and numpy's type), and the comments."""
    lines = [line.split() for line in text.splitlines()[1:] if line.split()]
    comments = [" ".join(rest) for word, *rest in lines if word == "comment"]
    try:
        kind = next((rest[0] for word, *rest in reversed(lines) if word == "format"), "")
        if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise ValueError(f"its format is '{kind}'")
        count, properties = _vertices(lines)
        _require_distinct([name for name, _ in properties])
    except (ValueError, KeyError, IndexError) as error:
        raise InputDataError(f"{path}: the .ply header cannot be read: {_reason(error)}.", _HEADER, _AGAIN) from None
    return kind, count, properties, comments


def _require_distinct(names: list[str]) -> None:
    """Raise ValueError for properties of which there is none, or one twice."""
    if not names:
        raise ValueError("its splats have no properties")
    twice = first_repeated(names)
    if twice is not None:
        raise ValueError(f"the property '{twice}' stands twice")


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"the type {error} is unknown"
    return "a line ends too early" if isinstance(error, IndexError) else str(error)


def _vertices(lines: list[list[str]]) -> tuple[int, list[tuple[str, str]]]:
    """Return the number and the properties of the element 'vertex', which has to be the first."""
    count, element = 0, ""
    properties: list[tuple[str, str]] = []
    for word, *rest in lines:
        if word == "element":
            if not element and rest[0] != "vertex":
                raise ValueError(f"its first element is '{rest[0]}', not 'vertex'")
            element = rest[0]
            count = _count(rest[1]) if element == "vertex" else count
        elif word == "property" and element == "vertex":
            properties.append((rest[1], _PLY_TYPES[rest[0]]))
    return count, properties
