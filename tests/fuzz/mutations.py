"""Mutations of inputs: each is a JSON object with an `op` and a `file`, drawn for a file, applied to a copy of it."""

from __future__ import annotations

import base64
import os
import socket
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from . import documents, hdf5
from .values import HARD_TEXTS, literals, numbers, texts

Mutation = dict[str, Any]
TEXTS = {".json": "json", ".toml": "toml"}
TABLES = (".csv", ".txt")
IMAGES = (".png", ".jpg")
KINDS = (
    *("directory", "fifo", "broken link", "own link", "link to /dev/zero", "link to /dev/full", "empty", "removed"),
    *("unreadable", "socket", "link to its folder"),
)
_UNREADABLE = os.geteuid() != 0


def mutations(path: Path, name: str) -> st.SearchStrategy[Mutation]:
    """Return a strategy of mutations of a file; `name` is its path in the case's folder."""
    named: Callable[[Mutation], Mutation] = lambda change: {"file": name, **change}  # noqa: E731
    kinds = [kind for kind in KINDS if kind != "unreadable" or _UNREADABLE]
    any_file = st.one_of(
        _bytes(path), _bytes(path), st.sampled_from(kinds).map(lambda kind: {"op": "kind", "to": kind})
    )
    suffix = path.suffix.lower()
    if suffix in TEXTS:
        own = _document(path, TEXTS[suffix])
    elif suffix in TABLES:
        own = _cells(path)
    elif suffix in (".h5", ".hdf5"):
        own = hdf5.mutations(path)
    elif suffix in IMAGES:
        own = _pictures()
    elif suffix == ".ply":
        own = _header(path)
    elif suffix in (".npz", ".pt"):
        own = _archives(path)
    else:
        return any_file.map(named)
    return st.one_of(own, own, own, own, any_file).map(named)


def apply(root: Path, change: Mutation) -> None:
    """Apply a mutation to the inputs in a folder, unless the file is none any more."""
    path = root / change["file"]
    if path.is_symlink() or not path.is_file():
        return
    _APPLY[change["op"]](path, change)


# Documents


def _document(path: Path, form: str) -> st.SearchStrategy[Mutation]:
    places = list(documents.paths(documents.parse(path.read_text(encoding="utf-8"), form)))
    place = st.sampled_from(places)
    value = literals(form)
    return st.one_of(
        st.fixed_dictionaries({"op": st.just("replace"), "at": place, "raw": value}),
        st.fixed_dictionaries({"op": st.just("replace"), "at": place, "raw": value}),
        st.fixed_dictionaries({"op": st.just("scale"), "at": place, "by": st.sampled_from(_FACTORS)}),
        st.fixed_dictionaries({"op": st.just("delete"), "at": place}),
        st.fixed_dictionaries({"op": st.just("duplicate"), "at": place, "raw": st.none() | value}),
        st.fixed_dictionaries({"op": st.just("add"), "at": place, "key": texts(), "raw": value}),
        st.fixed_dictionaries({"op": st.just("rename"), "at": place, "key": texts()}),
        st.fixed_dictionaries({"op": st.just("swap"), "at": place, "with": place}),
    )


_FACTORS = (-1.0, 0.0, 1e-3, 1e3, 1e6, 1e-6, 10.0, 1.5, 57.29577951308232)


def _change_document(path: Path, change: Mutation) -> None:
    form = TEXTS[path.suffix.lower()]
    tree = documents.parse(path.read_text(encoding="utf-8"), form)
    op, at = change["op"], change["at"]
    raw = None if change.get("raw") is None else documents.Raw(change["raw"])
    if op == "replace":
        documents.put(tree, at, raw)
    elif op == "scale":
        documents.put(tree, at, _scaled(documents.get(tree, at), change["by"]))
    elif op == "delete":
        documents.remove(tree, at)
    elif op == "duplicate":
        documents.duplicate(tree, at, documents.get(tree, at) if raw is None else raw)
    elif op in ("add", "rename"):
        parent = documents.get(tree, at[:-1])
        if isinstance(parent, documents.Table) and op == "add":
            parent.append((change["key"], raw))
        elif isinstance(parent, documents.Table):
            parent[:] = [(change["key"] if key == at[-1] else key, value) for key, value in parent]
        else:
            parent.append(raw or parent[at[-1]])
    else:
        one, other = documents.get(tree, at), documents.get(tree, change["with"])
        if at[: len(change["with"])] != change["with"] and change["with"][: len(at)] != at:
            documents.put(tree, at, other)
            documents.put(tree, change["with"], one)
    path.write_text(documents.dump(tree, form), encoding="utf-8", errors="surrogatepass")


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list) and not isinstance(value, documents.Table):
        return [_scaled(entry, factor) for entry in value]
    return value * factor if isinstance(value, int | float) and not isinstance(value, bool) else value


# Tables


def _cells(path: Path) -> st.SearchStrategy[Mutation]:
    lines = path.read_text(encoding="utf-8").splitlines()
    line = st.integers(0, len(lines) - 1)
    column = st.integers(0, max(len(text.replace(",", " ").split()) for text in lines) - 1)
    cell = st.one_of(
        numbers(), texts(), st.sampled_from(["nan", "inf", "1e400", "9" * 5000, "--1", "1,2", '"', "0x1p3"])
    )
    return st.one_of(
        st.fixed_dictionaries({"op": st.just("cell"), "line": line, "column": column, "text": cell}),
        st.fixed_dictionaries({"op": st.just("cell"), "line": line, "column": column, "text": cell}),
        st.fixed_dictionaries(
            {"op": st.just("line"), "line": line, "do": st.sampled_from(["drop", "twice", "swap", "half"])}
        ),
        st.fixed_dictionaries({"op": st.just("column"), "column": column, "text": st.none() | cell}),
        st.fixed_dictionaries({"op": st.just("column by"), "column": column, "by": st.sampled_from(_FACTORS)}),
        st.fixed_dictionaries({"op": st.just("columns"), "column": column, "with": column}),
    )


def _change_table(path: Path, change: Mutation) -> None:
    text = path.read_text(encoding="utf-8")
    separator = "," if "," in text else " "
    rows = [line.split(separator) for line in text.splitlines()]
    op, k = change["op"], change.get("column", 0)
    row = rows[change["line"]] if "line" in change else []
    if op == "cell":
        row[min(k, len(row) - 1)] = change["text"]
    elif op == "line":
        n = change["line"]
        if change["do"] == "drop":
            del rows[n]
        elif change["do"] == "twice":
            rows.insert(n, list(row))
        elif change["do"] == "half":
            rows[n] = row[: len(row) // 2]
        elif n + 1 < len(rows):
            rows[n], rows[n + 1] = rows[n + 1], rows[n]
    else:
        for number, cells in enumerate(rows):
            if k >= len(cells):
                continue
            if op == "columns" and change["with"] < len(cells):
                cells[k], cells[change["with"]] = cells[change["with"]], cells[k]
            elif op == "column by":
                cells[k] = _times(cells[k], change["by"])
            elif op == "column" and (number or change["text"] is None):
                cells[k : k + 1] = [] if change["text"] is None else [change["text"]]
    joined = "\n".join(separator.join(cells) for cells in rows) + "\n"
    path.write_text(joined, encoding="utf-8", errors="surrogatepass")


def _times(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


# Pictures, point clouds, archives


def _pictures() -> st.SearchStrategy[Mutation]:
    return st.fixed_dictionaries(
        {
            "op": st.just("picture"),
            "what": st.sampled_from(
                ["1x1", "twice", "16 bit", "alpha", "gray", "bomb", "black", "white", "animated", "other"]
            ),
        }
    )


def _change_picture(path: Path, change: Mutation) -> None:
    from PIL import Image

    picture = Image.open(path)
    picture.load()
    what = change["what"]
    form = {".png": "PNG", ".jpg": "JPEG"}[path.suffix]
    made = {
        "1x1": lambda: picture.resize((1, 1)),
        "twice": lambda: picture.resize((2 * picture.width, 2 * picture.height)),
        "16 bit": lambda: Image.fromarray(np.full((picture.height, picture.width), 40_000, np.uint16)),
        "alpha": lambda: picture.convert("RGBA"),
        "gray": lambda: picture.convert("L"),
        "bomb": lambda: Image.new("L", (20_000, 20_000)),
        "black": lambda: Image.new(picture.mode, picture.size, 0),
        "white": lambda: Image.new(
            picture.mode, picture.size, 255 if picture.mode == "L" else (255,) * len(picture.mode)
        ),
        "animated": lambda: picture,
        "other": lambda: picture,
    }[what]()
    if what == "other":
        form = "BMP"
    if form == "JPEG" and made.mode not in ("L", "RGB"):
        form = "PNG"
    made.save(
        path, form, **({"save_all": True, "append_images": [made]} if what == "animated" and form == "PNG" else {})
    )


def _header(path: Path) -> st.SearchStrategy[Mutation]:
    count = path.read_bytes().split(b"end_header")[0].count(b"\n") + 1
    line = st.integers(0, count - 1)
    return st.one_of(
        st.fixed_dictionaries({"op": st.just("header"), "line": line, "text": st.sampled_from(_PLY_LINES)}),
        st.fixed_dictionaries(
            {
                "op": st.just("floats"),
                "every": st.integers(1, 13),
                "value": st.sampled_from(["nan", "inf", "-inf", "1e30", "-1", "0", "1e-30"]),
            }
        ),
    )


_PLY_LINES = (
    *(
        "element vertex 0",
        "element vertex -1",
        "element vertex 999999999999",
        f"element vertex {'9' * 5000}",
        "element",
    ),
    *(
        "property float x",
        "property list uchar int y",
        "property double z",
        "format ascii 1.0",
        "format binary_big_endian 1.0",
    ),
    *("property float \x1b[31mx", "comment " + "x" * 70_000, "end_header", "", "ply"),
)


def _change_header(path: Path, change: Mutation) -> None:
    head, mark, data = path.read_bytes().partition(b"end_header\n")
    if change["op"] == "floats":
        values = np.frombuffer(data[: len(data) // 4 * 4], "<f4").copy()
        values[:: change["every"]] = np.float32(change["value"])
        path.write_bytes(head + mark + values.tobytes())
        return
    lines = (head + mark).split(b"\n")
    lines[min(change["line"], len(lines) - 1)] = change["text"].encode()
    path.write_bytes(b"\n".join(lines) + data)


class _Canary:
    """What runs if it is unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


def _archives(path: Path) -> st.SearchStrategy[Mutation]:
    whats = ["pickled", "text", "empty", "scalar", "complex", "huge", "nan", "negative", "fewer"]
    names = list(np.load(path).files) if path.suffix == ".npz" else ["tensor"]
    return st.fixed_dictionaries(
        {"op": st.just("array"), "name": st.sampled_from(names), "what": st.sampled_from(whats)}
    )


def _change_archive(path: Path, change: Mutation) -> None:
    canary = _Canary(str(path.parents[1] / "CANARY"))
    if path.suffix == ".pt":
        import torch

        tensor = torch.load(path, weights_only=True)
        made = {
            "pickled": canary, "text": "a text", "empty": torch.zeros(0), "scalar": torch.tensor(1.0),
            "complex": tensor * 1j, "huge": tensor[:, :1].expand(1, 10_000_000, tensor.shape[2]),
            "nan": tensor * float("nan"), "negative": -tensor, "fewer": tensor[..., :5],
        }[change["what"]]  # fmt: skip
        torch.save(made, path)
        return
    try:
        arrays = dict(np.load(path))
    except (OSError, ValueError, zipfile.BadZipFile):
        return  # an earlier change has damaged it
    one = arrays[change["name"]]
    made = {
        "pickled": np.array([canary], object), "text": np.array(["a", "b"]), "empty": np.zeros(0),
        "scalar": np.float64(1.0), "complex": one * 1j, "huge": np.zeros(20_000_000, np.uint8),
        "nan": one * np.nan, "negative": -one, "fewer": one[:-1] if one.ndim else one,
    }[change["what"]]  # fmt: skip
    np.savez_compressed(path, **{**arrays, change["name"]: made})


# Bytes and kinds of files


def _bytes(path: Path) -> st.SearchStrategy[Mutation]:
    place = st.floats(0, 1)
    return st.one_of(
        st.fixed_dictionaries({"op": st.just("truncate"), "at": place}),
        st.fixed_dictionaries(
            {"op": st.just("flip"), "at": st.lists(place, min_size=1, max_size=8), "bit": st.integers(0, 7)}
        ),
        st.fixed_dictionaries({"op": st.just("cut"), "at": place, "length": st.integers(1, 40)}),
        st.fixed_dictionaries(
            {"op": st.just("insert"), "at": place, "data": st.binary(min_size=1, max_size=12).map(_base)}
        ),
        st.fixed_dictionaries(
            {"op": st.just("insert"), "at": place, "data": st.sampled_from(HARD_TEXTS).map(lambda t: _base(t.encode()))}
        ),
        st.fixed_dictionaries(
            {"op": st.just("zeros"), "at": st.sampled_from([0.0, 0.3, 0.6]), "length": st.sampled_from([8, 64, 512])}
        ),
        st.fixed_dictionaries({"op": st.just("grow"), "length": st.sampled_from([1, 1000, 3_000_000])}),
        st.fixed_dictionaries({"op": st.just("splice"), "at": place, "from": place, "length": st.integers(1, 200)}),
    )


def _base(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _change_bytes(path: Path, change: Mutation) -> None:
    data = bytearray(path.read_bytes())
    op, size = change["op"], len(data)
    places = change.get("at", 0.0)
    at = int((places if isinstance(places, float | int) else 0) * size)
    if op == "truncate":
        del data[at:]
    elif op == "flip" and size:
        for place in places:
            data[min(int(place * size), size - 1)] ^= 1 << change["bit"]
    elif op == "cut":
        del data[at : at + change["length"]]
    elif op == "insert":
        data[at:at] = base64.b64decode(change["data"])
    elif op == "zeros":
        length = min(change["length"], size - at)
        data[at : at + length] = bytes(length)
    elif op == "grow":
        data += bytes(change["length"])
    elif op == "splice":
        start = int(change["from"] * size)
        data[at : at + change["length"]] = data[start : start + change["length"]]
    path.write_bytes(data)


def _change_kind(path: Path, change: Mutation) -> None:
    to = change["to"]
    if to == "unreadable":
        path.chmod(0)
        return
    path.unlink()
    if to == "directory":
        path.mkdir()
    elif to == "fifo":
        os.mkfifo(path)
    elif to == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            here = os.open(path.parent, os.O_RDONLY)
            made.bind(f"/proc/self/fd/{here}/{path.name}")  # a path of any length
            os.close(here)
    elif to == "empty":
        path.touch()
    elif to != "removed":
        targets = {"broken link": "nowhere", "own link": path.name, "link to /dev/zero": "/dev/zero"}
        path.symlink_to({**targets, "link to /dev/full": "/dev/full", "link to its folder": "."}[to])


_APPLY: dict[str, Callable[[Path, Mutation], None]] = {
    **dict.fromkeys(("replace", "scale", "delete", "duplicate", "add", "rename", "swap"), _change_document),
    **dict.fromkeys(("cell", "line", "column", "column by", "columns"), _change_table),
    **dict.fromkeys(("header", "floats"), _change_header),
    **dict.fromkeys(("truncate", "flip", "cut", "insert", "zeros", "grow", "splice"), _change_bytes),
    "picture": _change_picture,
    "array": _change_archive,
    "kind": _change_kind,
    "hdf5": hdf5.apply,
}
