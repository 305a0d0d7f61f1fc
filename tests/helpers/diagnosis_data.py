"""Tosses by our own engine with an effect, as tracks and as a capture with a model beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.capture.tracks import Track, write_tracks
from cgwm.datasets.models.model import Model, write_model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.diagnose.evidence.evidence import Evidence
from cgwm.pipeline.diagnose.evidence.score_test import ScoreTest
from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
from cgwm.pipeline.physics import State, World
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.segments.candidates import Candidate
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import (
    CAPTURE_FORMAT,
    Body,
    CaptureManifest,
    ContactParameters,
    Ground,
    ModelFile,
    Provenance,
    Shape,
    Solver,
)
from cgwm.schemas import World as ManifestWorld
from cgwm.schemas.capture import SphereShape
from cgwm.schemas.model import BodyModel
from helpers.worlds import F64, ball_body, box_body, law, world_of

NOISE = Noise(5e-4, 5e-3)
Effects = Mapping[str, Mapping[str, float]]


def world_with(body: str = "cube", effects: Effects | None = None, ground: bool = True) -> World:
    """A cube of 10 cm or a ball of 4 cm radius, with effects."""
    shape = box_body((0.05, 0.05, 0.05)) if body == "cube" else ball_body(0.04)
    plain = world_of(shape, contact=law(0.3, 0.004, 0.4), ground=ground, step_s=0.002)
    return replace(
        plain, effects=tuple(ActiveEffect.of(load_effect(name), dict(v)) for name, v in (effects or {}).items())
    )


def tosses(
    world: World,
    seed: int,
    count: int = 6,
    duration_s: float = 0.5,
    rate_hz: float = 100.0,
    noise: tuple[float, float] = NOISE,
    height_m: tuple[float, float] = (0.2, 0.6),
    lift_m_s: tuple[float, float] = (-0.5, 2.0),
) -> list[tuple[str, dict[str, Track]]]:
    """Tosses with random spin and heading, measured with noise."""
    rng = np.random.default_rng(seed)
    position = np.zeros((count, 1, 3))
    position[..., :2] = rng.uniform(-0.2, 0.2, (count, 1, 2))
    position[..., 2] = rng.uniform(*height_m, (count, 1))
    quat = rng.standard_normal((count, 1, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    heading, speed = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 2.0, count)
    velocity = np.zeros((count, 1, 3))
    velocity[:, 0] = np.stack([speed * np.cos(heading), speed * np.sin(heading), rng.uniform(*lift_m_s, count)], -1)
    omega = rng.standard_normal((count, 1, 3)) * rng.uniform(2, 10, (count, 1, 1))
    times = torch.arange(round(duration_s * rate_hz) + 1, dtype=F64) / rate_hz
    with torch.no_grad():
        motion = measure(world, State(*map(torch.as_tensor, (position, quat, velocity, omega))), times)
    moved = motion.position_m[:, :, 0].numpy() + noise[0] * rng.standard_normal((count, len(times), 3))
    jitter = quat_exp(torch.as_tensor(noise[1] * rng.standard_normal((count, len(times), 3))))
    turned = quat_multiply(motion.quat_wxyz[:, :, 0], jitter).numpy()
    name = world.bodies[0].name
    return [(f"{k:03d}", {name: Track(times.numpy(), moved[k], turned[k])}) for k in range(count)]


def write_capture(root: Path, world: World, episodes: Sequence[tuple[str, dict[str, Track]]], test: int = 2) -> Path:
    """Write a capture of a ball whose last episodes are the test split, and `<root>-model`; return the model."""
    body = world.bodies[0]
    names = [name for name, _ in episodes]
    radius = float(body.radii[0, 0])
    mass = float(body.mass[0])
    (root / "tracks").mkdir(parents=True)
    manifest = CaptureManifest(
        format=CAPTURE_FORMAT,
        world=ManifestWorld(ground=Ground()),
        bodies=(Body(name=body.name, mass_kg=mass, shape=Shape(sphere=SphereShape(radius_m=radius))),),
        splits={"train": tuple(names[:-test]), "test": tuple(names[-test:])},
    )
    write_manifest(root / "capture.toml", manifest)
    for name, tracks in episodes:
        write_tracks(root / "tracks" / f"{name}.csv", tracks)
    inertia = float(body.inertia[0, 0, 0])
    file = ModelFile(
        ground=Ground(),
        bodies=(
            BodyModel(
                name=body.name,
                motion="free",
                mass_kg=mass,
                inertia_kg_m2=(inertia, inertia, inertia, 0, 0, 0),
                com_m=(0, 0, 0),
                radius_factor=1.0,
            ),
        ),
        contact=ContactParameters(friction=0.32, contact_time_s=0.0045, damping_ratio=0.38),
        solver=Solver(step_s=0.002),
        provenance=Provenance(capture="none"),
    )
    sphere = Splats(np.zeros((1, 3)), np.array([radius]), np.array([0.9]), np.full((1, 3), 0.5))
    model = root.with_name(f"{root.name}-model")
    write_model(model, Model(root=None, file=file, body_splats={}, collision={body.name: sphere}, scene=None))
    return model


def evidence_of(name: str, values: Sequence[float] | None = None, **more: Any) -> Evidence:
    """Return evidence of an admissible effect with estimates, by default all 1 with errors of 1, and further fields."""
    effect = load_effect(name)
    estimate = np.ones(len(effect.parameters)) if values is None else np.array(values)
    size = len(estimate)
    test = ScoreTest(statistic=1.0, dof=size, p_value=1.0, estimate=estimate, covariance=np.eye(size), admissible=True)
    return Evidence(candidate=Candidate(name, effect), constants={}, test=test, p_value=1.0, **more)
