"""Physical and measurement effects: one file each, and the interface for custom effects."""

from .effect import (
    ActiveEffect,
    BodyMotion,
    Effect,
    EffectConstant,
    EffectParameter,
    Poses,
    Values,
    Wrench,
    horizontal,
    length,
    vector,
)
from .registry import effect_names, load_effect
from .trust import trust_effects

__all__ = [
    "ActiveEffect",
    "BodyMotion",
    "Effect",
    "EffectConstant",
    "EffectParameter",
    "Poses",
    "Values",
    "Wrench",
    "effect_names",
    "horizontal",
    "length",
    "load_effect",
    "trust_effects",
    "vector",
]
