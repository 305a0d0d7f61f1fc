"""Mutations of HDF5 files that leave them HDF5: values, types, shapes, links and attributes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hypothesis import strategies as st

from .values import HARD_TEXTS

VALUES = ("nan", "inf", "-inf", "0", "-1", "1", "1e30", "1e-30", "255", "1e9", "-1e9")
WHATS = (
    *("value", "first", "last", "scale", "negate", "shuffle", "text", "bytes", "bool", "complex", "compound", "object"),
    *("shorter", "longer", "flat", "scalar", "empty", "more axes", "huge", "huge chunks", "vast", "group", "delete"),
    *("renamed", "own link", "broken link", "external", "root link", "null", "int8", "float16", "enum", "reference"),
)
LARGEST = 1 << 22
"""An array that a mutation has already made vast is left."""
JSONS = (
    "{",
    "[1]",
    "",
    "null",
    "[" * 60_000,
    '{"a": NaN}',
    '{"a": {"value": "x"}}',
    '{"/tmp/x.py:X": {}}',
    "\x1b[31m",
    "1",
    '{"a":1,"a":2}',
)


def mutations(path: Path) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy of mutations of an HDF5 file."""
    names: list[str] = []
    attributes: list[tuple[str, str]] = []
    with h5py.File(path) as file:
        attributes += [("/", name) for name in file.attrs]

        def see(name: str, node: Any) -> None:
            names.append(name)
            own = [key for key in node.attrs if key not in ("frame", "order", "shape_meaning", "description")]
            attributes.extend((name, key) for key in own)

        file.visititems(see)
    place = st.sampled_from(names)
    own = st.fixed_dictionaries(
        {
            "op": st.just("hdf5"),
            "at": place,
            "what": st.sampled_from(WHATS),
            "value": st.sampled_from(VALUES),
            "with": place,
            "seed": st.integers(0, 99),
        }
    )
    if not attributes:
        return own
    value = st.one_of(
        st.sampled_from(HARD_TEXTS), st.sampled_from(JSONS), st.sampled_from([0, -1, 10**12, 1.5, None, [1, 2]])
    )
    attribute = st.fixed_dictionaries(
        {"op": st.just("hdf5"), "what": st.just("attribute"), "of": st.sampled_from(attributes), "value": value}
    )
    return st.one_of(own, own, attribute)


def apply(path: Path, change: dict[str, Any]) -> None:
    """Apply a mutation to an HDF5 file."""
    with h5py.File(path, "r+") as file:
        if change["what"] == "attribute":
            _set(file, change)
        else:
            _change(file, change)


def _set(file: h5py.File, change: dict[str, Any]) -> None:
    node, name = change["of"]
    attributes = file[node].attrs
    value = change["value"]
    if value is None:
        del attributes[name]
    else:
        if isinstance(value, str):
            value = np.void(value.encode(errors="surrogatepass")) if "\0" in value else value
        attributes[name] = value


def _change(file: h5py.File, change: dict[str, Any]) -> None:
    at, what = change["at"], change["what"]
    node = file[at]
    parent, name = node.parent, at.rsplit("/", 1)[-1]
    if what in _LINKS:
        del parent[name]
        parent[name] = _LINKS[what](at)
    elif what == "delete":
        del parent[name]
    elif what == "renamed":
        parent.move(name, f"{name}\x1b[31m{change['value']}")
    elif what == "group":
        del parent[name]
        parent.create_group(name)
    elif isinstance(node, h5py.Dataset) and (node.size or 0) < LARGEST:
        _change_array(parent, name, node, change)


_LINKS = {
    "own link": lambda at: h5py.SoftLink(f"/{at}"),
    "broken link": lambda at: h5py.SoftLink("/nowhere"),
    "external": lambda at: h5py.ExternalLink("nowhere.h5", "/x"),
    "root link": lambda at: h5py.SoftLink("/"),
}


def _change_array(parent: Any, name: str, node: h5py.Dataset, change: dict[str, Any]) -> None:
    attributes, options = dict(node.attrs), {}
    shape, kind, what = node.shape or (), node.dtype, change["what"]
    if what in ("huge", "huge chunks", "vast"):
        count = {"huge": 10**12, "huge chunks": 2 * 10**9, "vast": 10**17}[what]
        options = {"shape": (count, *shape[1:]), "dtype": kind, "chunks": (1 << 16, *shape[1:])}
    elif what in ("null", "reference", "enum", "compound", "object"):
        made = {
            "null": h5py.Empty(kind if kind.kind != "O" else "f8"),
            "reference": np.array([node.parent.ref], h5py.ref_dtype),
            "enum": np.zeros(shape, h5py.enum_dtype({"A": 0, "B": 1})),
            "compound": np.zeros(shape, [("a", "f8"), ("b", "i4")]),
            "object": np.array(["a", "b"], h5py.string_dtype()),
        }[what]
        options = {"data": made, **({"dtype": h5py.ref_dtype} if what == "reference" else {})}
    else:
        options = {"data": _array(np.asarray(node[()]), change)}
    del parent[name]
    made = parent.create_dataset(name, **options)
    for key, value in attributes.items():
        made.attrs[key] = value


def _array(values: np.ndarray, change: dict[str, Any]) -> Any:
    what, number = change["what"], np.float64(change["value"])
    is_number = values.dtype.kind in "fiub"
    rng = np.random.default_rng(change["seed"])
    if what in ("value", "first", "last", "scale", "negate", "shuffle"):
        if not is_number or not values.size:
            return values
        with np.errstate(all="ignore"):
            wide = values.astype(np.float64)
            flat = wide.reshape(-1)
            if what == "value":
                flat[rng.integers(flat.size)] = number
            elif what in ("first", "last"):
                flat[0 if what == "first" else -1] = number
            elif what == "scale":
                wide *= rng.choice([1e-3, 1e3, 1.5, 0.0])
            elif what == "negate":
                wide *= -1
            else:
                rng.shuffle(wide) if wide.ndim else None
            return wide.astype(values.dtype)
    made = {
        "text": lambda: np.array([b"text"] * max(1, len(np.atleast_1d(values)))),
        "bytes": lambda: np.void(b"\x1b[31m\x00"),
        "bool": lambda: np.ones(values.shape, bool),
        "complex": lambda: np.ones(values.shape, np.complex128),
        "shorter": lambda: values[:-1] if values.ndim else values,
        "longer": lambda: np.concatenate([values, values[-1:]]) if values.ndim else np.stack([values, values]),
        "flat": lambda: values.reshape(-1),
        "scalar": lambda: values.reshape(-1)[0] if values.size else 0.0,
        "empty": lambda: values[:0] if values.ndim else np.zeros(0),
        "more axes": lambda: values[None],
        "int8": lambda: values.astype(np.int8) if is_number else values,
        "float16": lambda: values.astype(np.float16) if is_number else values,
    }
    with np.errstate(all="ignore"):
        return made[what]()


def refresh(folder: Path) -> None:
    """Make the manifest of a dataset agree with its files again, as whoever forges one would."""
    from cgwm.datasets.io.atomic import sha256

    try:
        manifest = json.loads((folder / "dataset.json").read_text())
        for entry in [*manifest["shards"], *([manifest["index"]] if manifest.get("index") else [])]:
            path = folder / entry["file"]
            if path.is_file() and not path.is_symlink():
                entry |= {"sha256": sha256(path), "bytes": path.stat().st_size}
        if (folder / "model").is_dir():
            manifest["model_sha256"] = sha256(folder / "model")
        (folder / "dataset.json").write_text(json.dumps(manifest, indent=2))
    except (ValueError, KeyError, TypeError, OSError, AttributeError, RecursionError):
        return  # the manifest itself was mutated
