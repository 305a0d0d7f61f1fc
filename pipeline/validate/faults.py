"""Faults that the checks of a dataset find in a rollout."""

from __future__ import annotations

from dataclasses import dataclass

from ...schemas import Failure


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault within one rollout; `at` adds the shard and the rollout."""

    check: str
    """Name of the check that found it."""
    text: str
    """What is wrong, as a sentence."""
    frame: int | None = None
    """Frame in which it was found."""
    camera: str | None = None
    """Camera whose picture is concerned."""
    body: str | None = None
    """Body that is concerned."""
    value: float | None = None
    """The value that was found, in the unit given in the text."""
    limit: float | None = None
    """The limit that the value violates, same unit."""

    def at(self, shard: str, demo: str) -> Failure:
        """Return the fault for the report, with its shard and rollout."""
        text = f"{shard}, {demo}: {self.text}"
        finite = {
            name: float(value)
            for name, value in (("value", self.value), ("limit", self.limit))
            if value is not None and abs(value) < float("inf")
        }
        return Failure(
            check=self.check,
            shard=shard,
            demo=demo,
            frame=self.frame,
            camera=self.camera,
            body=self.body,
            text=text,
            **finite,
        )
