"""A model that does not describe the motion to which it was fitted."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .base import FileModel

Error = Annotated[float, Field(ge=0, le=1e30)]


class NotDescribed(FileModel):
    """Why a model is of no use for a motion: it predicts worse than a body without physics, or touches nothing."""

    sentence: str
    """The statement in words, with the likely cause."""
    cause: str
    """The likely cause."""
    episodes: Annotated[int, Field(ge=1)]
    """Number of episodes that were predicted, open loop."""
    error_m: Error | None
    """Mean error of the model [m]; None where its rollout diverges."""
    still_error_m: Error
    """That of a body that stands still from the end of the warm-up [m]."""
    steady_error_m: Error
    """That of a body that keeps its velocity [m]."""
    never_touches: bool
    """Whether nothing touches anything in the model, while the tracks show contact."""
    worse_than: Literal["still", "steady"] | None
    """What predicts far better than the model: a body that stands still, or one that keeps its velocity."""
