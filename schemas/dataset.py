"""A dataset on disk, `dataset.json`: its sampling plan, its shards, and what `cgwm synthesize` prints."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .base import FileModel

DATASET_FORMAT = "cgwm-dataset/1"
ROLLOUTS_FORMAT = "cgwm-rollouts/1"

NonNegative = Annotated[float, Field(ge=0)]
Range = tuple[float, float]


class SamplingPlan(FileModel):
    """Distributions that rollouts are drawn from, all uniform; what is left out follows from the bodies."""

    height_m: Range | None = None
    """Gap between the bounding sphere and the ground at the start [m]; default 0.5 to 3 radii."""
    offset_m: NonNegative | None = None
    """Largest horizontal distance from the place in the photos [m]; default half a bounding radius."""
    horizontal_speed_m_s: Range | None = None
    """Initial horizontal speed, in any direction [m/s]; default up to that of a fall from three radii."""
    vertical_speed_m_s: Range | None = None
    """Initial vertical velocity, positive upwards [m/s]; default from minus to plus half of that."""
    spin_rad_s: Range | None = None
    """Initial angular speed about a random axis [rad/s]; default up to that speed divided by the radius."""
    push_speed_m_s: Range = (0.1, 0.4)
    """Speed of a driven body, straight towards a free one [m/s]."""
    push_gap_m: Range = (0.005, 0.03)
    """Gap between the bounding spheres of pusher and object at the start [m]."""
    push_miss: Annotated[float, Field(ge=0, le=1)] = 0.4
    """Largest sideways miss of the pusher's line past the object's centre [bounding radii]."""
    parameter_spread: NonNegative = 1.0
    """Standard errors by which the physical parameters vary: 1 is the posterior, 0 the estimate."""
    views: Annotated[int, Field(ge=1, le=16)] = 2
    """Number of cameras, evenly spread over `view_azimuth_deg`, looking at the bodies."""
    view_azimuth_deg: Range = (-50.0, 50.0)
    """First and last camera's direction as seen from the bodies [deg], about world z, 0 = from -y."""
    view_elevation_deg: Annotated[float, Field(ge=-85, le=85)] = 30.0
    """Cameras' elevation above the bodies [deg]."""
    view_angle_deg: Annotated[float, Field(gt=1, lt=150)] = 50.0
    """Cameras' full vertical angle of view [deg]."""
    view_distance_m: Annotated[float, Field(gt=0)] | None = None
    """Cameras' distance from the bodies [m]; default: the sampled starts fill most of the image."""

    @model_validator(mode="after")
    def _ordered(self) -> SamplingPlan:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple) and value[1] < value[0]:
                raise ValueError(f"{name} is a range [low, high]; found {list(value)}")
        return self


class ShardEntry(FileModel):
    """One HDF5 file of a dataset."""

    file: str
    index: Annotated[int, Field(ge=0)]
    sha256: str
    bytes: int
    rollouts: int
    frames: int
    """Labelled camera images: rollouts x frames x cameras; time steps where there are no cameras."""


class DatasetManifest(FileModel):
    """`dataset.json`, the side manifest: what may differ between equal runs stands here."""

    format: Literal["cgwm-dataset/1"] = DATASET_FORMAT
    model: str = "model"
    """Folder with a copy of the model that made the dataset."""
    model_sha256: str
    config: dict[str, Any]
    """The resolved settings, without the shard's number."""
    rollouts: int
    """Rollouts of all shards together, whether they are there yet or not."""
    shard_count: Annotated[int, Field(ge=1)]
    shards: tuple[ShardEntry, ...] = ()
    """The shards that are complete, by index."""
    bodies: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    versions: dict[str, str] = {}
    notes: tuple[str, ...] = ()


class DatasetSummary(FileModel):
    """What `cgwm synthesize` reports."""

    dataset: str
    shard: str
    sha256: str
    bytes: int
    rollouts: int
    frames: int
    """Labelled camera images of this shard; time steps where there are no cameras."""
    contacts: int
    """Contact labels of this shard."""
    cameras: tuple[str, ...]
    seconds: float
    frames_per_s: float
    preview: tuple[str, ...] = ()
    """Pictures of the first rollouts, files beside the first shard."""
    notes: tuple[str, ...] = ()
