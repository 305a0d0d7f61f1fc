"""Checks of contacts one by one: that they push, and that the bodies are where their distances say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ...datasets.models.model import Model
from ..physics.model_world import fixed_surfaces
from ..physics.surfaces.fixed_surface import FixedSurface
from .faults import Fault
from .rollout import Rollout

REACH_SLACK = 1.5
"""Distance of a contact from what the bodies' places give, in units of how far their spheres reach from there; 1 is
the most that is possible."""


def check_contacts(rollout: Rollout) -> Iterator[Fault]:
    """Check contacts at existing frames and bodies; without a readable model their distances are not checked."""
    if not len(rollout.values["contacts/body_a"]):
        return
    yield from _check_pulls(rollout)
    if rollout.dataset.model is not None:
        yield from _check_distances(rollout, rollout.dataset.model)


def _frames(rollout: Rollout) -> np.ndarray:
    """Return the frame of each contact, shape (N,)."""
    return np.repeat(np.arange(rollout.attributes.frames), np.diff(rollout.values["contacts/offsets"]))


def _check_pulls(rollout: Rollout) -> Iterator[Fault]:
    """Check that contacts do not pull; effects may add forces that do."""
    contacts = rollout.part("contacts")
    pulls = (contacts["impulse_world"] * contacts["normal_world"]).sum(-1)
    scale = float(np.abs(contacts["impulse_world"]).max())
    if pulls.min() < -1e-6 * scale and not rollout.attributes.effects:
        frame = int(_frames(rollout)[pulls.argmin()])
        text = f"contacts/impulse_world: frame {frame}: a contact pulls by {-pulls.min():.2g} N s; contacts only push."
        yield Fault(check="contacts", text=text, frame=frame, value=float(pulls.min()), limit=0.0)


def _check_distances(rollout: Rollout, model: Model) -> Iterator[Fault]:
    """Check that the gap of each contact is one that spheres of its bodies can have at their places.

    The gap of a sphere to the ground is its body's height above it within the body's reach; that of a sphere to another
    body is at most their distance and both reaches, and deeper than both reaches nothing can be. The gap to a fixed
    surface is its body's distance from it within the reach; of a mesh, that from its box is the least.
    """
    contacts, places, frame = rollout.part("contacts"), rollout.values["bodies/pos"], _frames(rollout)
    reach = np.array([_reach_m(model, name) for name in rollout.bodies])
    a, b, gap = contacts["body_a"], contacts["body_b"], contacts["distance"]
    off = np.zeros(len(gap))
    on_ground, on_body = b == -1, b >= 0
    least = -1 - len(model.file.surfaces)
    if (b < least).any():
        row = int(b.argmin())
        text = f"contacts/body_b: frame {frame[row]}: {b[row]} is no surface of the model, whose last is {least}."
        yield Fault(check="contacts", text=text, frame=int(frame[row]), body=rollout.bodies[a[row]])
    if model.file.ground is not None:
        given = (model.file.ground.offset_m, "m")
        offset_m = rollout.attributes.parameters.get("ground_offset_m", given)[0]
        height = places[frame, a] @ np.asarray(model.file.ground.normal) - offset_m
        off[on_ground] = (np.abs(gap - height) - REACH_SLACK * reach[a])[on_ground]
    other = np.where(on_body, b, a)
    both = REACH_SLACK * (reach[a] + reach[other])
    apart = np.linalg.norm(places[frame, a] - places[frame, other], axis=-1)
    off[on_body] = (np.maximum(gap - apart, -gap) - both)[on_body]
    for number, surface in enumerate(_surfaces(model) if (b < -1).any() else ()):
        there = b == -2 - number
        far = surface.bound(torch.as_tensor(places[frame, a][there], dtype=torch.float64)[None])[0].numpy()
        lacking, exceeding = far - gap[there], gap[there] - far
        wrong = np.maximum(lacking, -gap[there] if surface.mesh is not None else exceeding)
        off[there] = wrong - REACH_SLACK * reach[a][there]
    if (off > 0).any():
        row = int(off.argmax())
        name = rollout.bodies[a[row]]
        text = f"contacts/distance: frame {frame[row]}: {gap[row]:.3g} m; where the bodies are, spheres of '{name}' "
        text += f"miss that by {off[row]:.3g} m or more."
        yield Fault(check="contacts", text=text, frame=int(frame[row]), body=name, value=float(gap[row]))


def _surfaces(model: Model) -> tuple[FixedSurface, ...]:
    return fixed_surfaces(model, lambda x: torch.as_tensor(np.asarray(x), dtype=torch.float64)[None])


def _reach_m(model: Model, name: str) -> float:
    """Return how far the colliding spheres of a body reach from its origin [m]; of an unknown body, any distance."""
    spheres = model.collision.get(name)
    listed = next((body for body in model.file.bodies if body.name == name), None)
    if spheres is None or listed is None or not len(spheres):
        return float("inf")
    return spheres.reach_m(listed.radius_factor)
