"""A fault that a check of a dataset finds in a rollout."""

from __future__ import annotations

from dataclasses import dataclass

from ..schemas import Failure


@dataclass(frozen=True)
class Fault:
    """What is wrong, which check found it, where, the number and its limit. The check adds no file and no rollout."""

    check: str
    text: str
    frame: int | None = None
    camera: str | None = None
    body: str | None = None
    value: float | None = None
    limit: float | None = None

    def at(self, shard: str, demo: str) -> Failure:
        """Return the fault with its place, for the report."""
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
