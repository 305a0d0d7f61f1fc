"""What `cgwm effects` reports."""

from __future__ import annotations

from typing import Literal

from .base import FileModel


class EffectParameterCard(FileModel):
    """A number of an effect; at 0 the effect changes nothing."""

    name: str
    unit: str
    sign: Literal["nonnegative", "any"]
    scale: float
    """A magnitude that matters, in the unit: what changes a motion of one second visibly."""
    limit: float
    """The largest magnitude admitted."""
    shared: Literal["all", "group", "episode"] = "all"
    """Whether one value serves all episodes, or each group of episodes, or each episode, has its own."""


class EffectConstantCard(FileModel):
    """A number that means nothing while the effect is neutral: it is tried at each value of a grid."""

    name: str
    unit: str
    grid: tuple[float, ...]


class EffectCard(FileModel):
    """An effect that can be added to a model."""

    name: str
    """What to pass to `fit --effects`: a name, or `path/to/file.py:ClassName`."""
    summary: str
    formula: str
    """In plain text; a: acceleration of the centre of mass, u: its velocity, omega: angular velocity (world)."""
    parameters: tuple[EffectParameterCard, ...]
    constants: tuple[EffectConstantCard, ...] = ()
    phase: Literal["flight", "contact", "measurement"]
    """Where it acts."""
    needs: tuple[str, ...] = ()
    """What it cannot do without: ground, drag, contact, spin (measured, or by orientations), orientation, driven."""
    reveals: str
    """The motion that shows it best."""
    aliases: tuple[str, ...] = ()
    """What it cannot be told apart from in free flight alone."""
    source: str


class EffectList(FileModel):
    """The effects that there are."""

    effects: tuple[EffectCard, ...]


class NewEffect(FileModel):
    """The template of a custom effect that was written."""

    path: str
    name: str
    """What to pass to `fit --effects`."""
