"""Settings of the stages. The resolved settings are written into what a stage makes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from .base import FileModel
from .model import repeated
from .plan import SamplingPlan
from .quantities import Duration, FrameRate, RadiusFactor, Seed, Side, Step, Steps

Device = Literal["auto", "cpu", "cuda"]


class CalibrateConfig(FileModel):
    """Settings of `cgwm calibrate`."""

    seed: Annotated[int, Field(ge=0, le=2**31 - 1001)] = 0
    """COLMAP counts seeds in 31 bits; attempts take the following ones."""
    max_features: Annotated[int, Field(ge=256, le=1_000_000)] = 4096
    max_image_size: Annotated[int, Field(ge=128, le=100_000)] = 1600
    """Photos are reduced to this longer side [px] for feature extraction."""
    retries: Annotated[int, Field(ge=0, le=1000)] = 4
    """Further attempts (other seeds, then more features) after a model that fails the self-check."""
    turntable: bool | None = None
    """Whether the camera stands and what it shows turns: features are then taken from the pixels that differ from the
    surroundings. Left out, the photos tell it: much looks the same at the same pixels of all. Unless it is false,
    cameras are constrained to a turn about one axis where the matches support that."""


class SplatConfig(FileModel):
    """Settings of the stage sg-gs."""

    seed: Seed = 0
    device: Device = "auto"
    iterations: Steps = 400
    max_body_spheres: Annotated[int, Field(ge=16, le=10_000_000)] = 4000
    """Most visual spheres of a body: with 2,500 bodies in photos of usual size are blurred. With 4,000 pictures of five
    scenes that no fit had seen agree within the body by 0.4 to 1.3 dB more, for 3 s of processor time."""
    max_scene_spheres: Annotated[int, Field(ge=16, le=10_000_000)] = 6000
    spheres: Annotated[int, Field(ge=16, le=10_000_000)] | None = None
    """Budget of a background whose spheres multiply and move to where they are needed; left out, `max_scene_spheres`
    that stay about where they begin, which is faster by far."""
    adaptive_iterations: Steps = 7000
    """Steps of the background's fit where there is a budget."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics of that background's colours; 0: the same from all sides."""
    joint: bool | None = None
    """Whether geometry and colours of bodies are fitted together, or geometry first, to silhouettes and geometry maps;
    left out, geometry comes first where there are maps beside the photos."""
    geometry_rate: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Where geometry comes first, how fast it still moves while colours are fitted, of how fast it moved before; 0
    leaves it as silhouettes and maps had it, the published form."""
    exposure: bool = False
    """Learn a gain of each colour channel for every photo: for photos whose exposure or white balance varies."""
    refine_poses: bool = False
    """Refine the poses of the photos' cameras first; the model then holds them in `cameras.json`."""
    flat_faces: bool = True
    """Put the faces of bodies on planes where held-out photos agree on these at least as well."""
    gloss: bool = False
    """Let colours of bodies depend on the direction of view where held-out photos are repeated better so."""
    bare_ground: bool = True
    """Lift the shadow that moving bodies cast on the ground in the photos, and fill in the ground that they hid."""
    turntable: bool = True
    """Write a film around what was fitted, `turntable.mp4`."""
    collision: Literal["distilled", "visual"] = "distilled"
    """What collides: a small set of spheres distilled from a body's solid, or its visual spheres themselves."""
    max_collision_spheres: Annotated[int, Field(ge=8, le=100_000)] = 200
    """Most spheres of a distilled set; fewer where their surface is within 0.2 % of the solid's size on average."""
    image_size: Annotated[int, Field(ge=32, le=16384)] = 320
    """Photos are reduced to this longer side [px] for fitting."""
    test_every: Annotated[int, Field(ge=2, le=1_000_000)] = 8
    """Every n-th photo is held out and its PSNR reported."""
    radius_factor: RadiusFactor = 2.0


class PhysConfig(FileModel):
    """Settings of the stage phys-geo."""

    seed: Seed = 0
    device: Device = "auto"
    supervise: Literal["tracks", "images", "both"] = "tracks"
    step_s: Step = 0.001
    population: Annotated[int, Field(ge=8, le=100_000)] | None = None
    """Samples in a generation of the global search; left out, 24 to 96, the fewer the more episodes there are."""
    generations: Annotated[int, Field(ge=2, le=10_000)] = 8
    """Generations of the global search; the first draws from the prior."""
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 10
    """Most steps of the local refinement (Levenberg-Marquardt)."""
    warmup_s: Duration = 0.1
    image_size: Annotated[int, Field(ge=32, le=16384)] = 320
    """Video frames are reduced to this longer side [px] for fitting."""
    geometry: bool | None = None
    """Whether the colliding spheres that touch are refined with the images, through the motion alone; left out, only
    under the paper's law, whose published form it is."""
    contact_law: Literal["closed_form", "paper"] = "closed_form"
    """Law of contact that is fitted: ours, or the ContactGaussian-WM paper's."""
    effects: tuple[str, ...] = ()
    """Effects to add to the model and to fit: names of built-in ones, or `path/to/file.py:ClassName`."""
    mass_distribution: bool | Literal["auto"] = "auto"
    """Whether it is fitted where the mass of free bodies is: its centre and second moments, from 8 tracked episodes or
    more. What the capture gives of them is then only the start. auto: where held-out training tosses are predicted
    better."""
    length_scale: bool | Literal["auto"] = "auto"
    """Whether the scale of the measured positions is fitted, as the effect `length_scale`. auto: where held-out
    training tosses are predicted better, and better than with another gravity, clock or drag."""

    @field_validator("effects")
    @classmethod
    def _once(cls, specs: tuple[str, ...]) -> tuple[str, ...]:
        twice = repeated(map(_without_units, specs))
        if twice is not None:
            raise ValueError(f"the effect '{twice}' stands twice; each can be added once, with one grouping")
        return specs


def _without_units(spec: str) -> str:
    """Return an effect as the user names it without @group or @episode; an @ in the path of its file is none."""
    plain, _, units = spec.rpartition("@")
    return plain if plain and "/" not in units else spec


class SynthesizeConfig(FileModel):
    """Settings of `cgwm synthesize`."""

    seed: Seed = 0
    device: Device = "auto"
    rollouts: Annotated[int, Field(ge=1, le=10_000_000)] = 8
    duration_s: Duration = 1.0
    frame_rate_hz: Annotated[FrameRate, Field(le=1e5)] = 30.0
    width: Side = 320
    height: Side = 240
    compression: Literal["zstd", "gzip", "none", "jpeg"] = "zstd"
    """Of images, depth and masks: lossless; `jpeg` is zstd but for the colours, which lose a little and take a third of
    the room."""
    shadows: bool = False
    """Whether moving bodies cast a shadow on the ground, under the lamp that photos or videos told."""
    batch: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Rollouts that are drawn and simulated together; it changes no byte. Left out, 64 on a GPU, 1 on
    the CPU."""
    shard: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    shards: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    plan: SamplingPlan = SamplingPlan()

    @model_validator(mode="after")
    def _shard(self) -> SynthesizeConfig:
        if self.shard >= self.shards:
            raise ValueError(f"shard {self.shard} of {self.shards}: they are numbered 0 to {self.shards - 1}")
        return self
