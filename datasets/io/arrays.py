"""Arrays in NumPy's files, .npy and .npz, whose declared size is compared with what is stored before it is read."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import InputDataError
from ...schemas.regular_files import MAX_BYTES, read_binary_file, require_regular_file

MOST_UNPACKED = 4 * MAX_BYTES
"""Largest size of an array in an archive once it is unpacked [bytes]."""


def read_npy(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file.

    Raises:
        InputDataError: If it is no such file, is cut off, or would run code (objects of Python).
    """
    return _parsed(str(path), read_binary_file(path, MOST_UNPACKED))


def read_npz(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return arrays of an .npz archive by name.

    Raises:
        InputDataError: If it is no such file, lacks an array, or one is cut off or larger than `MOST_UNPACKED`.
    """
    require_regular_file(path)
    allowed = ", ".join(names) + "."
    try:
        with zipfile.ZipFile(path) as archive:
            members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            found: dict[str, NDArray[Any]] = {}
            for name in names:
                if name not in members:
                    raise InputDataError(
                        f"{path}: no array '{name}'.", allowed, "add the array, or take the original file."
                    )
                if members[name].file_size > MOST_UNPACKED:
                    raise InputDataError(
                        f"{path}: '{name}' declares {members[name].file_size / 2**30:.1f} GiB.",
                        f"arrays of at most {MOST_UNPACKED / 2**30:g} GiB.",
                        "take the original file.",
                    )
                found[name] = _parsed(f"{path}: not an .npz that can be read: '{name}'", archive.read(members[name]))
            return found
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise InputDataError(
            f"{path}: not an .npz that can be read: {error}.",
            allowed,
            "take the original file, or write it again with numpy.savez.",
        ) from None


def _parsed(where: str, data: bytes) -> NDArray[Any]:
    """Return the array of the bytes of a .npy file."""
    stream = io.BytesIO(data)
    try:
        shape, fortran, dtype = _read_header(stream)
        if dtype.hasobject:
            raise ValueError("it holds objects of Python, and reading them could run code")
        body = data[stream.tell() :]
        count = 1
        for length in shape:
            count *= length
        if len(body) != count * dtype.itemsize:
            raise ValueError(f"it declares {dtype} {shape}, which is not {len(body)} bytes")
        array = np.frombuffer(body, dtype, count).reshape(shape, order="F" if fortran else "C")
    except (ValueError, TypeError, EOFError, OverflowError, SyntaxError, RecursionError, MemoryError) as error:
        raise InputDataError(
            f"{where}: no array that can be read: {str(error)[:160]}.",
            "an array of numbers, as numpy.save writes it.",
            "write it again, or take the original.",
        ) from None
    return array.copy()


def _read_header(stream: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return the shape, the order and the type that the header of a .npy file declares."""
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return read(stream)
    except ValueError:  # NumPy's words advise to trust the file
        raise ValueError("its header is no .npy header, or is damaged") from None
