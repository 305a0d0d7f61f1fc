"""Contact geometry, dynamics and simulation of bodies made of spheres."""

from .chains.chain import Chain, Joint
from .chains.joint_command import JointCommand
from .chains.state import joints_of, with_joints
from .contact_law import ContactLaw, damping_ratio_of, restitution
from .contact_record import ContactRecord
from .paper_law import PaperLaw
from .rollout import Rollout, simulate
from .world import Body, State, World, symmetric

__all__ = [
    "Body",
    "Chain",
    "ContactLaw",
    "ContactRecord",
    "Joint",
    "JointCommand",
    "PaperLaw",
    "Rollout",
    "State",
    "World",
    "damping_ratio_of",
    "joints_of",
    "restitution",
    "simulate",
    "symmetric",
    "with_joints",
]
