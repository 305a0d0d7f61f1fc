"""A small recurrent latent world model: two cameras' frames and the object's pose from a latent state that runs ahead.

In the manner of recurrent state-space models (Hafner et al., "Learning latent dynamics for planning from pixels",
2019): a deterministic GRU state h and a stochastic Gaussian state z; the prior of z sees h alone, the posterior sees
the frames too; decoders turn (h, z) into frames and pose. It begins with what every contender is given, the state at
the first frame, and the frames of that moment. What is predicted of the pose is its change since then, so that an
untrained model predicts an object that stays.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

LENGTH_M, SPEED_M_S, SPIN_RAD_S = 0.1, 1.0, 10.0
"""Units in which the network sees and predicts positions and velocities."""
START_SIZE, ACTION_SIZE = 18, 6
RATE, FREE_NATS, KL_WEIGHT, IMAGE_WEIGHT = 1e-3, 1.0, 0.05, 10.0
BATCH = {"cpu": 16, "cuda": 64}
"""Sequences of a step: a GPU takes more in the same time."""
SEEN_FRAMES, SHOWN_FRAMES = 8, 5
"""Frames of a sequence that the posterior sees; and how many, drawn anew each time, are compared as images."""
GRADIENT_NORM = 10.0


@dataclass(frozen=True, eq=False)
class Sequences:
    """Episodes of S, T frames each, float32.

    images (S, T, C, H, W): channels of all cameras, in [0, 1]; position_m (S, T, 3); rotation (S, T, 3, 3);
    velocity_m_s, omega_world_rad_s (S, T, 3); driven_m (S, T, D, 3): positions of the driven bodies; known (S, T):
    whether the pose is.
    """

    images: Tensor
    position_m: Tensor
    rotation: Tensor
    velocity_m_s: Tensor
    omega_world_rad_s: Tensor
    driven_m: Tensor
    known: Tensor

    def chunk(self, items: Tensor, first: Tensor, length: int) -> Sequences:
        """Return a stretch of each of some items (B,) from their first frames (B,); the last frame is repeated.

        What lies past the end is not known.
        """
        count = self.images.shape[1]
        frames = first[:, None] + torch.arange(length, device=first.device)
        rows = items[:, None], frames.clamp_max(count - 1)
        fields = {name: value[rows] for name, value in vars(self).items()}
        return Sequences(**{**fields, "known": fields["known"] & (frames < count)})

    def start(self) -> Tensor:
        """Return what the network sees of the states at the first frames (S, 18)."""
        parts = (self.position_m[:, 0] / LENGTH_M, self.rotation[:, 0].flatten(1), self.velocity_m_s[:, 0] / SPEED_M_S,
                 self.omega_world_rad_s[:, 0] / SPIN_RAD_S)  # fmt: skip
        return torch.cat(parts, -1)

    def actions(self) -> Tensor:
        """Return what it sees of the commands: where driven bodies are and will be (S, T - 1, 6 D)."""
        place = (self.driven_m - self.position_m[:, :1, None]) / LENGTH_M
        return torch.cat((place[:, :-1], place[:, 1:]), -1).flatten(2)


@dataclass(frozen=True)
class Latent:
    """A latent state: h (B, hidden) and z (B, stochastic)."""

    h: Tensor
    z: Tensor

    @property
    def both(self) -> Tensor:
        """Both as one vector."""
        return torch.cat((self.h, self.z), -1)


class LatentModel(nn.Module):
    """The networks.

    Args:
        mean_image: What the images are on average (C, H, W), sides multiples of 16; the decoder adds to it.
        driven: Number of driven bodies.
        hidden: Size of h.
        stochastic: Size of z.
    """

    def __init__(self, mean_image: Tensor, driven: int, hidden: int = 192, stochastic: int = 24) -> None:
        super().__init__()
        channels, height, width = mean_image.shape
        self.mean_image: Tensor
        self.register_buffer("mean_image", mean_image.clone())
        small = (64, height // 16, width // 16)
        flat = math.prod(small)
        self.encoder = nn.Sequential(
            _down(channels, 16), _down(16, 32), _down(32, 64), _down(64, 64), nn.Flatten(), nn.Linear(flat, 128)
        )
        self.begin = _perceptron(START_SIZE, hidden)
        self.cell = nn.GRUCell(stochastic + ACTION_SIZE * driven, hidden)
        self.prior = _perceptron(hidden, 2 * stochastic)
        self.posterior = _perceptron(hidden + 128, 2 * stochastic)
        self.pose = _perceptron(hidden + stochastic, 9)
        self.decoder = nn.Sequential(
            nn.Linear(hidden + stochastic, flat), nn.SiLU(), nn.Unflatten(1, small),
            _up(64, 64), _up(64, 32), _up(32, 16), nn.ConvTranspose2d(16, channels, 4, 2, 1),
        )  # fmt: skip
        for last in (self.pose[-1], self.decoder[-1]):
            assert isinstance(last, nn.Linear | nn.ConvTranspose2d)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)  # pyright: ignore[reportArgumentType]

    def first(self, start: Tensor, image: Tensor, generator: torch.Generator | None = None) -> tuple[Latent, Tensor]:
        """Return the latent state of a start (B, 18) with its images (B, C, H, W), and the terms of its KL (B,)."""
        h = torch.tanh(self.begin(start))
        return self._observed(h, self.encoder(image - self.mean_image), generator)

    def observe(
        self, latent: Latent, action: Tensor, code: Tensor, generator: torch.Generator | None
    ) -> tuple[Latent, Tensor]:
        """Return the next latent state with the images' code (B, 128) seen, and its KL from the prior (B,)."""
        return self._observed(self.cell(torch.cat((latent.z, action), -1), latent.h), code, generator)

    def imagine(self, latent: Latent, action: Tensor, generator: torch.Generator | None = None) -> Latent:
        """Return the next latent state from the prior alone; without a generator its mean."""
        h = self.cell(torch.cat((latent.z, action), -1), latent.h)
        return Latent(h, _drawn(_normal(self.prior(h)), generator))

    def poses(self, latents: Tensor, position_m: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions (B, T, 3) [m] and rotations (B, T, 3, 3) of latents (B, T, n), from those at the start.

        Rotations from six numbers: Zhou et al., "On the continuity of rotation representations", 2019.
        """
        change = self.pose(latents)
        unturned = change.new_tensor([1.0, 0, 0, 0, 1, 0])
        first, second = (change[..., 3:] + unturned).unflatten(-1, (2, 3)).unbind(-2)
        x = nn.functional.normalize(first, dim=-1)
        y = nn.functional.normalize(second - (second * x).sum(-1, keepdim=True) * x, dim=-1)
        turn = torch.stack((x, y, torch.linalg.cross(x, y)), -1)
        return position_m[:, None] + LENGTH_M * change[..., :3], turn @ rotation[:, None]

    def images(self, latents: Tensor) -> Tensor:
        """Return images (..., C, H, W) of latents (..., n)."""
        pictures = self.decoder(latents.flatten(0, -2)) + self.mean_image
        return pictures.unflatten(0, latents.shape[:-1])

    def _observed(self, h: Tensor, code: Tensor, generator: torch.Generator | None) -> tuple[Latent, Tensor]:
        prior, posterior = _normal(self.prior(h)), _normal(self.posterior(torch.cat((h, code), -1)))
        # balanced: the prior learns faster to foresee the posterior than that to be foreseen
        fixed = kl_divergence(_fixed(posterior), prior).sum(-1), kl_divergence(posterior, _fixed(prior)).sum(-1)
        kl = 0.8 * fixed[0].clamp_min(FREE_NATS) + 0.2 * fixed[1].clamp_min(FREE_NATS)
        return Latent(h, _drawn(posterior, generator)), kl


def loss_of(model: LatentModel, data: Sequences, generator: torch.Generator) -> Tensor:
    """Return the loss of sequences: with frames seen, and open loop from the first."""
    actions, known = data.actions(), data.known.float()
    seen = min(SEEN_FRAMES, data.images.shape[1])
    codes = model.encoder((data.images[:, :seen] - model.mean_image).flatten(0, 1)).unflatten(0, (-1, seen))
    latent, kl = model.first(data.start(), data.images[:, 0], generator)
    latents, kls, ahead = [latent.both], [kl], latent
    for frame in range(1, seen):
        latent, kl = model.observe(latent, actions[:, frame - 1], codes[:, frame], generator)
        latents.append(latent.both)
        kls.append(kl)
    foreseen = [ahead.both]
    for frame in range(1, data.images.shape[1]):
        ahead = model.imagine(ahead, actions[:, frame - 1], generator)
        foreseen.append(ahead.both)
    observed, imagined = torch.stack(latents, 1), torch.stack(foreseen, 1)
    loss = KL_WEIGHT * _mean(torch.stack(kls, 1), known[:, :seen])
    for states in (observed, imagined):
        count = states.shape[1]
        loss = loss + _pose_loss(model, states, data, known[:, :count])
        some = torch.randint(0, count, (SHOWN_FRAMES,), generator=generator, device=known.device)
        square = (model.images(states[:, some]) - data.images[:, some]).square().flatten(2).mean(-1)
        loss = loss + IMAGE_WEIGHT * _mean(square, known[:, some])
    return loss


def train(
    model: LatentModel, data: Sequences, seed: int, most_steps: int, left_s: Callable[[], float], horizon: int
) -> list[float]:
    """Train until the steps or the time are spent; return the loss of each step.

    Args:
        model: On the data's device.
        data: All that there is to learn from.
        seed: Draws batches and latents.
        most_steps: Most steps of Adam.
        left_s: Returns how much time is left [s].
        horizon: Frames of a sequence.
    """
    device = data.images.device
    batch = BATCH[device.type]
    generator = torch.Generator(device).manual_seed(seed)
    adam = torch.optim.Adam(model.parameters(), RATE)
    total_s, losses = max(left_s(), 1e-9), []
    places = data.known[:, :-1].nonzero()  # where a sequence may begin
    begins = data.known.float().argmax(1)
    for step in range(most_steps):
        spent = max(step / most_steps, 1 - left_s() / total_s)
        if spent >= 1:
            break
        adam.param_groups[0]["lr"] = RATE * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * spent)))
        items, first = places[torch.randint(len(places), (batch,), generator=generator, device=device)].unbind(1)
        early = torch.rand(batch, generator=generator, device=device) < 0.5
        first = torch.where(early, begins[items], first)  # tests begin where episodes do
        loss = loss_of(model, data.chunk(items, first, horizon), generator)
        adam.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), GRADIENT_NORM)
        adam.step()
        losses.append(float(loss.detach()))
    return losses


@torch.no_grad()
def predicted(model: LatentModel, data: Sequences) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions (S, T, 3), rotations (S, T, 3, 3) and images (S, T, C, H, W), open loop from the first frame.

    Of the sequences' images and states only the first are read, and all commands. Every latent is its mean.
    """
    latent, _ = model.first(data.start(), data.images[:, 0])
    latents = [latent.both]
    for action in data.actions().unbind(1):
        latent = model.imagine(latent, action)
        latents.append(latent.both)
    states = torch.stack(latents, 1)
    poses = model.poses(states, data.position_m[:, 0], data.rotation[:, 0])
    return *poses, model.images(states).clamp(0, 1)


def stopwatch(budget_s: float | None) -> Callable[[], float]:
    """Return how much of a budget is left [s], as a function; without one it is endless."""
    end = math.inf if budget_s is None else time.perf_counter() + budget_s
    return lambda: 1e9 if end == math.inf else end - time.perf_counter()


def _pose_loss(model: LatentModel, latents: Tensor, data: Sequences, weight: Tensor) -> Tensor:
    count = latents.shape[1]
    position, rotation = model.poses(latents, data.position_m[:, 0], data.rotation[:, 0])
    apart = nn.functional.smooth_l1_loss(
        position / LENGTH_M, data.position_m[:, :count] / LENGTH_M, reduction="none", beta=0.1
    ).sum(-1)
    turned = (rotation - data.rotation[:, :count]).square().flatten(2).sum(-1)
    return _mean(5.0 * apart + turned, weight)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1.0)


def _normal(numbers: Tensor) -> Normal:
    mean, spread = numbers.chunk(2, -1)
    return Normal(mean, nn.functional.softplus(spread) + 0.1, validate_args=False)


def _fixed(normal: Normal) -> Normal:
    return Normal(normal.mean.detach(), normal.stddev.detach(), validate_args=False)


def _drawn(normal: Normal, generator: torch.Generator | None) -> Tensor:
    if generator is None:
        return normal.mean
    noise = torch.randn(normal.mean.shape, generator=generator, device=normal.mean.device)
    return normal.mean + normal.stddev * noise


def _perceptron(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 192), nn.SiLU(), nn.Linear(192, 192), nn.SiLU(), nn.Linear(192, outputs))


def _down(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 4, 2, 1), nn.SiLU())


def _up(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, 4, 2, 1), nn.SiLU())
