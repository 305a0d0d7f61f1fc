"""Contact geometry, dynamics and rollouts of bodies made of spheres."""

from .contact import ContactLaw, restitution
from .rollout import ContactRecord, Rollout, simulate
from .world import Body, State, World, symmetric

__all__ = [
    "Body",
    "ContactLaw",
    "ContactRecord",
    "Rollout",
    "State",
    "World",
    "restitution",
    "simulate",
    "symmetric",
]
