"""Where the links of a jointed body are at random values of its joints, to compare an exported file with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ...datasets.models.model import Model
from ...schemas import ArticulationModel
from ..physics.chains.chain import chain_of_model

Pose = tuple[np.ndarray, np.ndarray]
"""Position [m] (3,) and rotation matrix (3, 3)."""
_MOST = 1.0
"""Largest value of a joint without limits [rad or m]."""


@dataclass(frozen=True)
class Places:
    """Poses of links relative to the root."""

    root: str
    """Name of the root."""
    joints: dict[str, float]
    """Values of the joints that move [rad or m], by name."""
    places: dict[str, Pose]
    """Position [m] (3,) and rotation matrix (3, 3) of each link in the root's frame, by name."""


def chain_places(model: Model, one: ArticulationModel, rng: np.random.Generator) -> Places:
    """Draw values of the joints within their limits, and return where the links are."""
    like = torch.zeros(1, dtype=torch.float64)
    chain = chain_of_model(one, like)
    low, high = (chain.numbers(name)[0].numpy() for name in ("lower", "upper")) if chain.moving else (like, like)
    values = rng.uniform(np.maximum(low, -_MOST), np.minimum(high, _MOST)) if chain.moving else np.zeros(0)
    origin, upright = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    position, quat = chain.poses(origin, upright, torch.as_tensor(values)[None])
    places = {
        name: (position[0, k].numpy(), Rotation.from_quat(quat[0, k].numpy(), scalar_first=True).as_matrix())
        for k, name in enumerate(chain.links)
    }
    return Places(one.root, dict(zip(chain.joint_names, map(float, values), strict=True)), places)


def worst_deviation(
    model: Model, seed: int, places_of: Callable[[ArticulationModel, Places], Mapping[str, Pose]]
) -> tuple[float, float]:
    """Return the largest distance [mm] and angle [deg] of links at random values of all joints; 0 without joints.

    Args:
        model: The model.
        seed: Seed of the values.
        places_of: Gives the poses of the links of a jointed body in the exported file, relative to the root.
    """
    rng, worst = np.random.default_rng(seed), (0.0, 0.0)
    for one in model.file.articulations:
        wanted = chain_places(model, one, rng)
        away = deviation(places_of(one, wanted), wanted.places)
        worst = max(worst[0], away[0]), max(worst[1], away[1])
    return worst


def deviation(found: Mapping[str, Pose], wanted: Mapping[str, Pose]) -> tuple[float, float]:
    """Return the largest distance [mm] and angle [deg] between poses of the same names."""
    away = [1e3 * float(np.linalg.norm(found[name][0] - place)) for name, (place, _) in wanted.items()]
    turns = [Rotation.from_matrix(found[name][1].T @ turn).magnitude() for name, (_, turn) in wanted.items()]
    return max(away, default=0.0), float(np.degrees(max(turns, default=0.0)))
