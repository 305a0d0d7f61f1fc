"""Physical and measurement effects: one file each, and the interface for one's own."""

from .effect import (
    ActiveEffect,
    BodyMotion,
    Effect,
    EffectConstant,
    EffectParameter,
    Poses,
    Values,
    Wrench,
    length,
    vector,
)

__all__ = [
    "ActiveEffect",
    "BodyMotion",
    "Effect",
    "EffectConstant",
    "EffectParameter",
    "Poses",
    "Values",
    "Wrench",
    "length",
    "vector",
]
