"""Changes of valid inputs that the tables of `refused` and `accepted` are written in."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from . import documents, hdf5
from .subjects import FAST_FIT, SYNTHESIZE

Edit = Callable[[Path], None]
Columns = dict[str, np.ndarray]

FIT = ("fit", "capture", "--out", "OUT", "--stage", "phys-geo", *FAST_FIT)
SYNTH = ("synthesize", "model", "--out", "OUT", *SYNTHESIZE)


@dataclass(frozen=True)
class Row:
    """A line of a table: a subject with a change, and the command that has to refuse or to accept it."""

    name: str
    kind: str
    subject: str
    edit: Edit
    words: tuple[str, ...]


def nothing(root: Path) -> None:
    """Change nothing."""


def several(*edits: Edit) -> Edit:
    """Return the edits as one."""

    def edit(root: Path) -> None:
        for one in edits:
            one(root)

    return edit


def field(file: str, at: str, raw: str) -> Edit:
    """Replace or add a field of a JSON or TOML file: keys and indices with blanks between, the value as text."""

    def edit(root: Path) -> None:
        path = root / file
        form = path.suffix[1:]
        tree = documents.parse(path.read_text(), form)
        place: list[Any] = [int(part) if part.isdigit() else part for part in at.split()]
        if len(place) == 2 and isinstance(place[0], str) and place[0] not in [key for key, _ in tree]:
            tree.append((place[0], documents.Table()))
        place = [
            str(p) if isinstance(documents.get(tree, place[:k]), documents.Table) else p for k, p in enumerate(place)
        ]
        parent = documents.get(tree, place[:-1])
        if isinstance(parent, documents.Table) and place[-1] not in [key for key, _ in parent]:
            parent.append((place[-1], documents.Raw(raw)))
        else:
            documents.put(tree, place, documents.Raw(raw))
        path.write_text(documents.dump(tree, form))

    return edit


def without(file: str, at: str) -> Edit:
    """Remove a field of a JSON or TOML file."""

    def edit(root: Path) -> None:
        path = root / file
        tree = documents.parse(path.read_text(), path.suffix[1:])
        documents.remove(tree, [int(part) if part.isdigit() else part for part in at.split()])
        path.write_text(documents.dump(tree, path.suffix[1:]))

    return edit


def twice(file: str, at: str, raw: str) -> Edit:
    """Put a second entry with the same key, or after the element of a list."""

    def edit(root: Path) -> None:
        path = root / file
        tree = documents.parse(path.read_text(), path.suffix[1:])
        place: list[Any] = [int(part) if part.isdigit() else part for part in at.split()]
        documents.duplicate(tree, place, documents.Raw(raw) if raw else documents.get(tree, place))
        path.write_text(documents.dump(tree, path.suffix[1:]))

    return edit


def text(file: str, old: str, new: str) -> Edit:
    """Replace a text of a file, which has to be there."""

    def edit(root: Path) -> None:
        found = (root / file).read_text()
        assert old in found, f"{file} has no {old!r}"
        (root / file).write_text(found.replace(old, new, 1))

    return edit


def written(file: str, content: str | bytes) -> Edit:
    """Write a file."""

    def edit(root: Path) -> None:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_bytes(content if isinstance(content, bytes) else content.encode())

    return edit


def tracks(change: Callable[[Columns], None], folder: str = "capture/tracks") -> Edit:
    """Change the columns of all tracks: arrays by name, and `body` as texts."""

    def edit(root: Path) -> None:
        for path in sorted((root / folder).glob("*.csv")):
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
            columns = {key: value if key == "body" else value.astype(float) for key, value in columns.items()}
            change(columns)
            lines = [
                ",".join(str(columns[key][k]) for key in columns) for k in range(len(next(iter(columns.values()))))
            ]
            path.write_text("\n".join([",".join(columns), *lines]) + "\n")

    return edit


def scaled(names: str, factor: float) -> Callable[[Columns], None]:
    """Return a change that multiplies columns."""

    def change(columns: Columns) -> None:
        for name in names.split():
            columns[name] = columns[name] * factor

    return change


def rolled(names: str, order: str) -> Callable[[Columns], None]:
    """Return a change that writes the values of columns under other names."""

    def change(columns: Columns) -> None:
        old = dict(columns)
        for name, other in zip(names.split(), order.split(), strict=True):
            columns[name] = old[other]

    return change


def array(at: str, change: Callable[[np.ndarray], Any], forged: bool = True) -> Edit:
    """Change an array of a dataset, and its hashes with it: of the demo with the most contacts, of cameras in all."""

    def edit(root: Path) -> None:
        path = sorted((root / "dataset").glob("rollouts-*.h5"))[0]
        with h5py.File(path, "r+") as file:
            demos = list(file["data"].values())
            if not at.startswith(("cameras/", "obs/", "light/")):
                demos = [max(demos, key=lambda one: len(one["contacts/mode"]))]
            for demo in demos:
                made = np.asarray(change(np.asarray(demo[at][()])))
                attributes = dict(demo[at].attrs)
                del demo[at]
                demo[at] = made
                for key, value in attributes.items():
                    demo[at].attrs[key] = value
        if forged:
            hdf5.refresh(root / "dataset")

    return edit


def shard(change: Callable[[h5py.File], Any]) -> Edit:
    """Change the first shard of a dataset, and its hashes with it."""

    def edit(root: Path) -> None:
        with h5py.File(sorted((root / "dataset").glob("rollouts-*.h5"))[0], "r+") as file:
            change(file)
        hdf5.refresh(root / "dataset")

    return edit


def kind_of(file: str, to: str) -> Edit:
    """Replace a file by a directory, a named pipe, or a link to somewhere."""

    def edit(root: Path) -> None:
        path = root / file
        path.unlink(missing_ok=True)
        if to == "directory":
            path.mkdir()
        elif to == "fifo":
            os.mkfifo(path)
        elif to != "removed":
            path.symlink_to(path.name if to == "itself" else to)

    return edit


def model_json(change: Callable[[dict[str, Any]], None]) -> Edit:
    """Change a model's file as an object of Python."""

    def edit(root: Path) -> None:
        path = root / "model" / "model.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data, indent=1))

    return edit
