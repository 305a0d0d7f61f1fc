"""Import of a folder of photos, as phones and cameras write them."""

from __future__ import annotations

from pathlib import Path

from ...schemas.imports import ImportResult
from ..capture.files import repeated
from ..io.atomic import new_directory
from ..io.outputs import reads
from .photo_captures import copy_photos, left_in, photos_in, require_unpacked, write_photo_capture


@reads("source")
def import_photos(source: Path | str, out: Path | str, overwrite: bool = False) -> ImportResult:
    """Write the photos of a folder as a capture, whose cameras `cgwm calibrate` estimates.

    JPEG and PNG files are copied as they are; HEIC is converted to JPEG, turned upright, with its EXIF data. The
    colours of a wide-gamut photo are kept as numbers, not converted. A file that is there twice is taken once.

    Args:
        source: The folder.
        out: The capture directory to write.
        overwrite: Replace `out`.

    Raises:
        InputDataError: If the folder has no photo, or one is damaged.
        UsageError: If `out` exists, before anything is read.
    """
    with new_directory(out, "capture", overwrite) as directory:
        source = require_unpacked(Path(source))
        photos = photos_in(source)
        again = repeated([photo.source for photo in photos])
        photos = [photo for photo in photos if photo.source not in again]
        copy_photos(directory, photos)
        notes = [f"{copy.name} is the same file as {first.name} and was left out" for copy, first in again.items()]
        notes += left_in(source)
        return write_photo_capture(directory, out, len(photos), warnings=notes)
