"""Contact geometry, dynamics and simulation of bodies made of spheres."""

from .contact_law import ContactLaw, damping_ratio_of, restitution
from .contact_record import ContactRecord
from .paper_law import PaperLaw
from .rollout import Rollout, simulate
from .world import Body, State, World, symmetric

__all__ = [
    "Body",
    "ContactLaw",
    "ContactRecord",
    "PaperLaw",
    "Rollout",
    "State",
    "World",
    "damping_ratio_of",
    "restitution",
    "simulate",
    "symmetric",
]
