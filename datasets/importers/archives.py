"""Archives of recordings, read like the folders that they hold."""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from ...schemas import InputDataError
from ...schemas.regular_files import require_regular_file

ENDINGS = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".txz", ".tar.bz2")
"""Ends of the names of archives."""
_MOST_BYTES = 1_000_000_000
_MOST_ENTRIES = 100_000


@contextmanager
def unpacked(source: Path, endings: Sequence[str]) -> Iterator[Path]:
    """Yield the folder itself, or one with the files of an archive whose names end so, in folders named as theirs."""
    if source.is_dir():
        yield source
        return
    with tempfile.TemporaryDirectory() as place:
        try:
            with tarfile.open(require_regular_file(source)) as archive:
                _unpack(source, archive, endings, Path(place))
        except (tarfile.TarError, EOFError, OSError) as error:
            if isinstance(error, InputDataError):
                raise
            raise InputDataError(
                f"{source}: it is no archive that can be read.", "a folder, or a .tar.xz.", "download it again."
            ) from None
        yield Path(place)


def _unpack(source: Path, archive: tarfile.TarFile, endings: Sequence[str], place: Path) -> None:
    """Write the files of an archive whose names end so, by their names and those of their folders alone."""
    for number, entry in enumerate(archive):
        name = PurePosixPath(entry.name)
        if not entry.isfile() or name.suffix.lower() not in endings:
            continue
        if entry.size > _MOST_BYTES or number > _MOST_ENTRIES:
            raise InputDataError(
                f"{source}: '{name}' is too large.", f"up to {_MOST_BYTES} bytes.", "take the original archive."
            )
        content = archive.extractfile(entry)
        folder = place / name.parent.name.replace("..", "_")
        folder.mkdir(exist_ok=True)
        (folder / name.name).write_bytes(b"" if content is None else content.read())
