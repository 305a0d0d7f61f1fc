"""What `cgwm mask` writes beside the masks: `masks.json`."""

from __future__ import annotations

from typing import Literal

from .base import FileModel


class PhotoMask(FileModel):
    """The mask of a photo."""

    share: float
    """Share of the pixels that the body fills."""
    doubt: str = ""
    """Why the mask should be looked at; empty where nothing speaks against it."""


class MasksReport(FileModel):
    """`masks.json`."""

    format: Literal["cgwm-masks/1"] = "cgwm-masks/1"
    method: Literal["opacity", "plain", "turntable", "box", "empty"]
    """What told the body from the rest: the opacity of the photos, a background of one colour, surroundings that stand,
    a box, or a film of the empty place."""
    body: str = ""
    """Name of the body; empty where the photos were not those of a capture with bodies."""
    label: int
    """Its label in the masks."""
    photos: dict[str, PhotoMask]
    """By photo, or by frame of a video: `<camera>/<episode>/<frame>.png`."""
    versions: dict[str, str] = {}

    @property
    def doubtful(self) -> dict[str, str]:
        """The photos whose masks should be looked at, with the reason."""
        return {name: photo.doubt for name, photo in self.photos.items() if photo.doubt}

    def __str__(self) -> str:
        """Return the summary that the command prints."""
        shares = sorted(photo.share for photo in self.photos.values())
        found = {
            "opacity": "what is opaque in the photos",
            "plain": "what stands before a background of one colour",
            "turntable": "what turns before surroundings that stand",
            "box": "what is in the box, and looks alike in the other photos",
            "empty": "what differs from the empty place",
        }[self.method]
        lines = [
            f"{len(self.photos)} masks of {self.body or 'the body'}, label {self.label}: {found}; it fills "
            f"{100 * shares[0]:.1f} to {100 * shares[-1]:.1f} % of the pictures"
        ]
        lines += [f"look at {name}: {doubt}" for name, doubt in self.doubtful.items()]
        if self.method == "box" and 2 * len(self.doubtful) > len(self.photos):
            lines.append(
                "the colours of most photos do not tell the body: draw these masks by hand, or delete the wrong ones, "
                "whose photos then serve the background alone"
            )
        return "\n".join(lines)
