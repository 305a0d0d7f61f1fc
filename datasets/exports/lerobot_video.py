"""The videos of a LeRobot dataset: H.264 in MP4, several episodes per file up to a maximum size.

Every second frame is a key frame, as LeRobot itself writes, so that single frames decode quickly.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .lerobot_files import FilePlaces

CODEC = "h264"
PIXEL_FORMAT = "yuv420p"
QUALITY_CRF = 18
KEY_FRAME_EVERY = 2
MAX_FILE_BYTES = 200 << 20
"""Size above which the next episode begins a new file."""


class EpisodeVideos:
    """Writer of the videos of one camera.

    Args:
        root: The dataset's directory.
        key: The feature's name, `observation.images.<camera>`.
        rate: Frames per second.
        size: Width and height [px], both even.
    """

    def __init__(self, root: Path, key: str, rate: Fraction, size: tuple[int, int]):
        self._root, self._key, self._rate, self._size = root, key, rate, size
        self._places = FilePlaces()
        self._container: Any = None
        self._stream: Any = None
        self._path = root
        self._frames = 0
        self._first = 0

    def begin(self) -> None:
        """Begin an episode."""
        size = self._path.stat().st_size if self._path.exists() else 0  # nothing is written of the first frames at once
        if self._container is not None and size > MAX_FILE_BYTES:
            self.close()
            self._places.advance()
        if self._container is None:
            self._open()
        self._first = self._frames

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append a frame, uint8 RGB (H, W, 3)."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = self._frames, 1 / self._rate
        self._container.mux(self._stream.encode(frame))
        self._frames += 1

    def end(self) -> dict[str, int | float]:
        """End the episode; return its columns of the episodes' table."""
        columns: dict[str, int | float] = dict(self._places.columns(f"videos/{self._key}"))
        columns[f"videos/{self._key}/from_timestamp"] = float(self._first / self._rate)
        columns[f"videos/{self._key}/to_timestamp"] = float(self._frames / self._rate)
        return columns

    def close(self) -> None:
        """Flush the encoder, and close the file."""
        if self._container is not None:
            self._container.mux(self._stream.encode())
            self._container.close()
            self._container = None

    def _open(self) -> None:
        import av

        self._path = self._root / "videos" / self._key / self._places.name(".mp4")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self._path), "w")
        options = {"crf": str(QUALITY_CRF), "g": str(KEY_FRAME_EVERY), "bf": "0"}
        self._stream = self._container.add_stream(CODEC, rate=self._rate, options=options)
        self._stream.width, self._stream.height = self._size
        self._stream.pix_fmt = PIXEL_FORMAT
        self._frames = 0
