"""Contact geometry, dynamics and simulation of bodies made of spheres."""

from .body import Body
from .chains.chain import Chain, Joint
from .chains.joint_command import JointCommand
from .chains.state import joints_of, with_joints
from .contact_law import ContactLaw, damping_ratio_of, restitution
from .contact_record import ContactRecord
from .inertia import symmetric
from .model_world import world_of_model
from .paper_law import PaperLaw
from .rollout import Rollout, simulate
from .state import State
from .world import World

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
    "world_of_model",
]
