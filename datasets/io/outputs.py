"""Which existing output a command may replace: one of the same kind that cgwm wrote, and nothing that it reads.

Every directory that cgwm writes holds the record `.cgwm-output.json`: the kind of the output, and its files with the
SHA-256 of the small ones. `--overwrite` replaces a directory only if its record names the same kind, and only while it
holds nothing else: a file that was added or edited belongs to the user. A file is recognised by its content.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, get_args

from ...schemas import OutputExistsError, UsageError
from ...schemas.regular_files import real_path
from .neighbours import clean_stale
from .places import require_place

RECORD = ".cgwm-output.json"
_FORMAT = "cgwm-output/1"
_HASHED_BYTES = 1 << 16
"""Maximum size of the files whose content is recorded; larger ones nobody edits by hand."""
_HEAD_BYTES = 1 << 12

DirectoryKind = Literal[
    "model", "dataset", "capture", "demo", "ladder", "run", "masks", "LeRobot dataset", "BOP dataset",
    "nerfstudio capture", "COLMAP model", "splat folder", "URDF folder", "SDF folder",
]  # fmt: skip
FileKind = Literal[
    "page", "MJCF file", "USD file", "glTF file", "splat file", "index", "effect", "effect template", "calibration",
    "truth", "track file", "manifest", "Rerun recording", "calibration target", "intrinsics",
]  # fmt: skip

_DIRECTORY_KINDS = frozenset(get_args(DirectoryKind))

_REPEATABLE = frozenset(
    {"MJCF file", "USD file", "glTF file", "splat file", "effect template", "index", "calibration target"}
)

_SYSTEM_FILES = re.compile(
    r"(.*/)?(\.DS_Store|Thumbs\.db|desktop\.ini|__pycache__/.*|\..*\.(partial|pending|replaced)-.*)"
)
_ADDED: Mapping[str, re.Pattern[str]] = {
    "capture": re.compile(r"cameras\.json|calibration\.json|sparse_points(\.\d+)?\.ply|sparse\.\d+/.*"),
    "dataset": re.compile(r"dataset\.json|index\.h5|rollouts-\d+-of-\d+\.(h5|json)|preview\.(png|webm)"),
}
"""Files that other commands of cgwm add to an output or rewrite in it, by its kind; see :func:`_is_added`."""

_INPUTS: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
_NESTED: ContextVar[bool] = ContextVar("nested", default=False)
"""Whether what is written is a part of an unfinished output."""
_REQUEST: ContextVar[str] = ContextVar("request", default="")
"""Digest of what the command was asked for; empty where it is not recorded."""
_PLACED: list[tuple[Path, int]] = []
"""Final names that outputs of this process were about to get, with the inodes of these."""


P = ParamSpec("P")
R = TypeVar("R")


def reads(*names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Protect inputs of a function from the outputs that it writes; a decorator.

    Args:
        names: Parameters that are paths, sequences of paths, or None.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def protected(*args: P.args, **kwargs: P.kwargs) -> R:
            given = signature.bind(*args, **kwargs).arguments
            values = [given.get(name) for name in names]
            paths = [path for value in values for path in (value if isinstance(value, list | tuple) else [value])]
            with _reading(path for path in paths if path is not None):
                return function(*args, **kwargs)

        return protected

    return decorate


@contextmanager
def inside_output() -> Iterator[None]:
    """Suspend the protection for what is written inside of an output whose name was checked."""
    token, nested = _INPUTS.set(()), _NESTED.set(True)
    try:
        yield
    finally:
        _INPUTS.reset(token)
        _NESTED.reset(nested)


def about_to_place(temporary: Path, path: Path) -> None:
    """Note that a complete output is about to get its final name, unless it is a part of another one."""
    if not _NESTED.get():
        _PLACED.append((path, temporary.stat().st_ino))


def forget_completed() -> None:
    """Begin a new command: what was written before is none of its outputs."""
    _PLACED.clear()


def completed() -> list[Path]:
    """Return the outputs to which this command has given their final names, and which are there."""
    return [path for path, inode in _PLACED if path.exists() and path.stat().st_ino == inode]


@contextmanager
def _reading(inputs: Iterable[Path | str]) -> Iterator[None]:
    token = _INPUTS.set((*_INPUTS.get(), *(real_path(path) for path in inputs)))
    try:
        yield
    finally:
        _INPUTS.reset(token)


def refuse_output(path: Path, kind: DirectoryKind | FileKind, overwrite: bool) -> None:
    """Raise an error for an output that exists and may not be replaced, or that would damage an input.

    What a killed command left of this output is removed before.

    Raises:
        UsageError: If it exists and `overwrite` is not set or it is no output of cgwm of this kind; if it is, holds or
            lies among the inputs of the command; or if it is or holds the home or working directory, or a git work
            tree; or if nothing can be written under that name.
    """
    require_place(path)
    clean_stale(path)  # which may give an old output, that a killed command was replacing, its name back
    exists = os.path.lexists(path)
    if exists and not overwrite:
        raise OutputExistsError(path)
    place = real_path(path)
    if exists:
        _refuse_protected(path, place)
        _refuse_part(path, place)
    for source in _INPUTS.get():
        _refuse_input(path, place, source)
    if not exists:
        return
    fault = _directory_fault(path, kind) if kind in _DIRECTORY_KINDS else _file_fault(path, kind)
    if fault:
        raise UsageError(
            f"{path} {fault}; --overwrite does not remove it.",
            f"{_with_article(kind)} that cgwm wrote and that nobody has changed.",
            "choose another name, or move it away.",
        )


def is_own_file(path: Path, kind: FileKind) -> bool:
    """Return whether a file is one of this kind that cgwm wrote and nobody has changed."""
    return path.is_file() and path.stat().st_size > 0 and not _file_fault(path, kind)


def may_repeat(path: Path, kind: DirectoryKind | FileKind) -> bool:
    """Return whether a file is cgwm's own, of a kind that the same command writes with the same bytes again."""
    if kind not in _REPEATABLE or os.path.islink(path) or not os.path.isfile(path):  # neither fails on a long name
        return False
    return is_own_file(path, kind)  # pyright: ignore[reportArgumentType]


@contextmanager
def made_for(request: str) -> Iterator[None]:
    """Record in the output directories of a command which request they answer."""
    token = _REQUEST.set(request)
    try:
        yield
    finally:
        _REQUEST.reset(token)


def answers(folder: Path, request: str) -> bool:
    """Return whether a directory is the complete and unchanged output of a request."""
    record = _read_record(folder)
    if record is None or record.get("request") != request:
        return False
    return not _directory_fault(folder, str(record.get("kind")))


def write_record(folder: Path, kind: DirectoryKind) -> None:
    """Record the kind and the files of a complete output directory in it."""
    files = {name: _digest(folder / name) for name in _names(folder)}
    request = {} if _NESTED.get() or not _REQUEST.get() else {"request": _REQUEST.get()}
    text = json.dumps({"format": _FORMAT, "kind": kind, "files": files} | request, indent=0, sort_keys=True)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def _with_article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiouM' else 'a'} {kind}"


def _refuse_protected(path: Path, place: Path) -> None:
    here, home = Path.cwd().resolve(), Path.home().resolve()
    if place in (here, home) or place in here.parents or place in home.parents or (place / ".git").exists():
        reason = "holds a .git" if (place / ".git").exists() else "is, or contains, the home or working directory"
        raise UsageError(f"{path} {reason}; --overwrite does not remove it.", todo="choose another name.")


def _refuse_part(path: Path, place: Path) -> None:
    """Refuse a part of another output, whose record names it; the parts of a demo are outputs of their own."""
    for folder in place.parents:
        record = _read_record(folder)
        if record is None:
            continue
        kind, name = str(record["kind"]), place.relative_to(folder).as_posix()
        listed = any(f"{file}/".startswith(f"{name}/") for file in record["files"])
        if kind != "demo" and listed and not _is_added(folder, kind, name):
            raise UsageError(
                f"{path} is a part of the {kind} {folder}; --overwrite does not remove it.", todo="choose another name."
            )
        return


def _refuse_input(path: Path, place: Path, source: Path) -> None:
    if place == source or (place.exists() and source.exists() and place.samefile(source)):
        found = f"{path} is an input of this command"
    elif source.is_relative_to(place):
        found = f"{path} holds an input of this command, {source}"
    elif place.is_relative_to(source) and not os.path.lexists(place) and _among_files(place, source):
        found = f"{path} would lie among the files of an input of this command, {source}"
    else:
        return
    raise UsageError(f"{found}.", todo="choose another name for the output.")


def _among_files(place: Path, source: Path) -> bool:
    """Return whether the nearest existing folder of a new output is one inside of an input that holds files."""
    folder = place.parent
    while not folder.exists():
        folder = folder.parent
    return folder != source and any(entry.is_file() for entry in folder.iterdir())


def _directory_fault(path: Path, kind: str) -> str:
    if not path.is_dir():
        return f"is a file, and no {kind}"
    names = _names(path)
    if not names:
        return ""
    record = _read_record(path)
    if record is None or record.get("kind") != kind:
        return f"holds no {kind}" + ("" if record is None else f" but {_with_article(str(record.get('kind')))}")
    own = [name for name in names if not _is_added(path, kind, name)]
    return next(filter(None, (_change(path, name, record["files"]) for name in own)), "")


def _change(folder: Path, name: str, files: Mapping[str, str]) -> str:
    """Return why a file is not as cgwm wrote it, by the digests of those that it wrote; "" if it is."""
    if name not in files:
        return f"holds {name}, which cgwm did not write"
    return "" if files[name] == _digest(folder / name) else f"holds {name}, which was changed since cgwm wrote it"


def _is_added(folder: Path, kind: str, name: str) -> bool:
    """Return whether another command of cgwm adds this file to such an output or rewrites it there.

    In a capture it is `calibrate`, whose report lies beside the cameras; without it they are the user's own.
    """
    added = _ADDED.get(kind)
    if added is None or not added.fullmatch(name):
        return False
    return kind != "capture" or _is_calibrated(folder / "cameras.json")


def _read_record(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads((path / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    whole = isinstance(found, dict) and found.get("format") == _FORMAT and isinstance(found.get("files"), dict)
    return found if whole else None


def _names(folder: Path) -> list[str]:
    """Return the files and links in a folder, relative to it, without the record and what systems leave behind."""
    names = []
    for parent, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(parent, name))]
        names += [os.path.relpath(os.path.join(parent, name), folder).replace(os.sep, "/") for name in files + links]
    return sorted(name for name in names if name != RECORD and not _SYSTEM_FILES.fullmatch(name))


def _digest(file: Path) -> str | None:
    if file.is_symlink():
        return f"link to {os.readlink(file)}"
    if not file.is_file() or file.stat().st_size > _HASHED_BYTES:
        return None
    return hashlib.sha256(file.read_bytes()).hexdigest()


def signed(text: str) -> str:
    """Return a text that a user may edit, with a last line by which it is recognised as long as nobody has."""
    return f"{text}# written by cgwm, sha256 {hashlib.sha256(text.encode()).hexdigest()}\n"


def _file_fault(path: Path, kind: str) -> str:
    if not path.is_file():
        return f"is no file, and no {kind}"
    try:
        recognised = path.stat().st_size == 0 or _RECOGNISED[kind](path)
    except (OSError, ValueError):
        recognised = False
    return "" if recognised else f"is no {kind} of cgwm, or was changed"


def _head(*signs: bytes) -> Callable[[Path], bool]:
    def recognise(path: Path) -> bool:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
        return all(sign in head for sign in signs)

    return recognise


def _is_mjcf(path: Path) -> bool:
    """Return whether a file is MJCF of cgwm; its source stands behind the bodies."""
    text = path.read_bytes()
    return text.startswith(b"<mujoco") and b'data="cgwm, of ' in text[-_HEAD_BYTES:]


def _is_index(path: Path) -> bool:
    import h5py

    with h5py.File(path, "r") as file:
        return "shards" in file and "data" in file


def _is_calibrated(path: Path) -> bool:
    """Return whether cameras are those that `calibrate` wrote, with its report beside them."""
    report = path.parent / "calibration.json"
    if not (path.is_file() and report.is_file()):
        return False
    return _head(b'"cgwm-cameras/')(path) and _head(b'"cgwm-calibration/')(report)


def _is_unchanged(path: Path) -> bool:
    text = path.read_text(encoding="utf-8")
    body, _, last = text.rstrip("\n").rpartition("\n")
    return signed(body + "\n") == f"{body}\n{last}\n"


_RECOGNISED: Mapping[str, Callable[[Path], bool]] = {
    "page": _head(b"<!doctype html>", b'<meta name="generator" content="cgwm">'),
    "MJCF file": _is_mjcf,
    "USD file": _head(b"#usda 1.0", b"Written by cgwm"),
    "glTF file": _head(b"glTF", b'"generator":"cgwm"'),
    "Rerun recording": _head(b"RRF2", b"cgwm"),
    "calibration target": _head(b"cgwm: ChArUco board"),
    "intrinsics": _head(b'"cgwm-intrinsics/'),
    "splat file": _head(b"ply\n", b"comment unit metre\ncomment frame "),
    "index": _is_index,
    "effect": _is_unchanged,
    "effect template": _is_unchanged,
    "calibration": _is_calibrated,
    "truth": _head(b"{", b'"case"'),
    "track file": lambda path: False,  # part of a capture, and often the user's own
    "manifest": lambda path: False,
}
