"""Captures: opening and checking the directory that a user fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...schemas import CaptureManifest, read_toml
from ..io.kinds import refuse_other_kind
from .cameras import read_cameras
from .check import check_capture
from .folder import CaptureFolder
from .links import with_links


class Capture(CaptureFolder):
    """A capture directory that was opened with :meth:`open`."""

    @classmethod
    def open(
        cls, path: Path | str, check: bool = True, splits: Sequence[str] | None = None, accept_units: bool = False
    ) -> Capture:
        """Open a capture.

        Args:
            path: The directory.
            check: Check everything that can be checked without decoding photos or videos.
            splits: Restrict the capture to the episodes of these splits; others may be absent or wrong.
            accept_units: Do not refuse units and frames that the motion contradicts.

        Raises:
            InputDataError: For the first fault, with file, line or field.
        """
        root = Path(path)
        refuse_other_kind(root, "capture")
        manifest = with_links(root, read_toml(root / "capture.toml", CaptureManifest))
        cameras = read_cameras(root, manifest.calibration.supplied_in_metres)
        capture = cls(root, manifest, cameras, None if splits is None else tuple(splits))
        if check:
            facts = check_capture(capture, accept_units)
            return replace(capture, inconsistencies=tuple(facts.inconsistencies))
        return capture
