"""Contact geometry, dynamics and rollouts of bodies made of spheres."""

from .contact import ContactLaw, damping_ratio_of, restitution
from .published import PublishedLaw
from .records import ContactRecord
from .rollout import Rollout, simulate
from .world import Body, State, World, symmetric

__all__ = [
    "Body",
    "ContactLaw",
    "ContactRecord",
    "PublishedLaw",
    "Rollout",
    "State",
    "World",
    "damping_ratio_of",
    "restitution",
    "simulate",
    "symmetric",
]
