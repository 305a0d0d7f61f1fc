"""A jointed body as one body: in flight the centre of mass of its links moves as a ball does, whatever the joints do.

Forces in the joints are internal, so that the momentum of all links changes by gravity and by what acts from outside
alone (Newton's laws). The centre of mass follows from the links' poses and masses. Its flights are those of a body
without orientation that touches nothing; losses of the joints, contacts and moments do not show in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ...datasets.capture.tracks import Episode, Track
from ...schemas import InputDataError
from ..geometry.rotation import quat_rotate
from ..physics.body import Body
from ..physics.chains.chain import Chain
from ..physics.world import World
from ..trajectories.observations import Observations
from ..trajectories.segmentation import cut_episodes, size_of, whole_episodes
from ..trajectories.track_noise import noise_of


def as_one_body(
    world: World, episodes: Sequence[Episode], given: tuple[float | None, float | None], place: str
) -> tuple[World, tuple[Episode, ...]]:
    """Return a world in which a jointed body is one body, and the flights of its centre of mass as episodes.

    Args:
        world: The model's world.
        episodes: Name and tracks by link of each episode.
        given: Standard deviations of the links' tracks (position [m], rotation [rad]) where they are known.
        place: Capture or model, for messages.

    Raises:
        InputDataError: If something else moves freely, or the root is not free.
    """
    chain = _only_chain(world, place)
    links = [world.bodies[world.body_names.index(name)] for name in chain.links]
    whole = whole_episodes(world, episodes)
    names = [world.bodies[k].name for k in world.tracked]
    # by which frames count as clear of the ground
    rough = noise_of(given, [tracks[name] for _, tracks in episodes for name in names if name in tracks])
    flights, _, _ = cut_episodes(world, whole, rough)
    flying = torch.zeros_like(whole.seen[..., 0], dtype=torch.bool)
    for item in flights:
        flying[item.episode, item.first : item.last + 1] = True
    center, known = _center_of_mass(world, whole, links)
    known &= flying
    flown = tuple(
        Episode(name, {chain.name: Track(whole.times_s[k, at].numpy(), center[k, at].numpy())})
        for k, (name, at) in enumerate(zip(whole.names, known, strict=True))
        if bool(at.any())
    )
    alone = replace(
        world,
        bodies=(_one_body(world, chain, links, center, whole),),
        chains=(),
        ground_normal=None,
        ground_offset=None,
        surfaces=(),
        pair_laws={},
    )
    return alone, flown


def _only_chain(world: World, place: str) -> Chain:
    others = [f"'{world.bodies[k].name}'" for k in world.free]
    chain = world.chains[0]
    if len(world.chains) > 1 or others or chain.base != "free":
        moving = ", ".join([*(f"'{one.name}' ({one.base} root)" for one in world.chains), *others])
        raise InputDataError(
            f"{place}: what moves is {moving}.",
            "one jointed body with a free root, and nothing else that moves freely.",
            "use 'cgwm compare', which shows in which phase of the motion, and at which link, predictions miss.",
        )
    return chain


def _center_of_mass(world: World, whole: Observations, links: Sequence[Body]) -> tuple[Tensor, Tensor]:
    """Return the centre of mass (E, T, 3) [m] of the links, and where all of them were measured (E, T)."""
    total = sum(float(link.mass[0]) for link in links)
    center, known = torch.zeros_like(whole.position_m[:, :, 0]), torch.ones_like(whole.seen[..., 0], dtype=torch.bool)
    for column, index in enumerate(whole.free):
        link = world.bodies[index]
        own = whole.position_m[:, :, column] + quat_rotate(whole.quat_wxyz[:, :, column], link.com[0])
        center = center + float(link.mass[0]) / total * own
        known &= (whole.seen[..., column] > 0) & (whole.has_orientation[..., column] > 0)
    return center, known


def _one_body(world: World, chain: Chain, links: Sequence[Body], center: Tensor, whole: Observations) -> Body:
    """Return a ball of the mass of all links that holds all of them at all times."""
    mass = torch.stack([link.mass[:1] for link in links]).sum(0)
    reach = 0.0
    for column, index in enumerate(whole.free):
        far = (whole.position_m[:, :, column] - center).norm(dim=-1)[whole.seen[..., column] > 0]
        reach = max(reach, float(far.amax()) + size_of(world.bodies[index]))
    return replace(
        links[0],
        name=chain.name,
        motion="free",
        mass=mass,
        inertia=0.4 * mass * reach**2 * torch.eye(3).to(mass)[None],
        com=torch.zeros_like(links[0].com[:1]),
        centers=mass.new_zeros(1, 1, 3),
        radii=mass.new_full((1, 1), reach),
        on_plane=None,
        hull=None,
        patch=None,
    )
