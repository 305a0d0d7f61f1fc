"""A dataset on disk, `dataset.json`: its shards, and what `cgwm synthesize` prints."""

from __future__ import annotations

from pathlib import PureWindowsPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from .base import FileModel
from .model import repeated
from .plan import SamplingPlan
from .regular_files import leads_outside

DATASET_FORMAT = "cgwm-dataset/1"
ROLLOUTS_FORMAT = "cgwm-rollouts/1"
Count = Annotated[int, Field(ge=0, le=10**15)]


def _inside(path: str) -> str:
    if not PureWindowsPath(path).parts or leads_outside(path) or not path.isprintable():
        raise ValueError("a path within the dataset is relative and has no '..'")
    return path


def _plain(name: str) -> str:
    if len(PureWindowsPath(_inside(name)).parts) != 1:
        raise ValueError("a file of a dataset lies in its folder; its name has no '/'")
    return name


PathInside = Annotated[str, AfterValidator(_inside)]
"""Path of a folder within a dataset."""
FileName = Annotated[str, AfterValidator(_plain)]
"""Name of a file in the folder of a dataset."""


class ShardEntry(FileModel):
    """One HDF5 file of a dataset."""

    file: FileName
    index: Annotated[int, Field(ge=0, le=1_000_000)]
    sha256: str
    bytes: Count
    rollouts: Count
    frames: Count
    """Labelled camera images: rollouts x frames x cameras; time steps where there are no cameras."""
    rejected: dict[str, Count] = {}
    """Draws that the plan's rules rejected, by rule; each was drawn again."""
    model_sha256: str | None = None
    """Hash of the model that it was made of."""
    versions: dict[str, str] = {}
    """What it was made with, as in the manifest."""
    device: str | None = None
    """cpu or cuda: the two agree to a tolerance, not to the byte."""


class IndexEntry(FileModel):
    """The file that `cgwm merge` writes: all shards as one, by HDF5 virtual datasets."""

    file: FileName
    sha256: str
    bytes: Count


class DatasetManifest(FileModel):
    """`dataset.json`, the side manifest: what may differ between equal runs stands here."""

    format: Literal["cgwm-dataset/1"] = DATASET_FORMAT
    model: PathInside = "model"
    """Folder with a copy of the model that made the dataset."""
    model_sha256: str
    config: dict[str, Any]
    """The resolved settings, without the shard's number."""
    rollouts: Count
    """Rollouts of all shards together, whether they are there yet or not."""
    shard_count: Annotated[int, Field(ge=1, le=1_000_000)]
    shards: tuple[ShardEntry, ...] = ()
    """The shards that are complete, by index; of several shards each has an entry file, until `cgwm merge`."""
    index: IndexEntry | None = None
    bodies: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    versions: dict[str, str] = {}
    notes: tuple[str, ...] = ()

    @field_validator("shards")
    @classmethod
    def _once(cls, shards: tuple[ShardEntry, ...]) -> tuple[ShardEntry, ...]:
        for what, names in (("number", (str(s.index) for s in shards)), ("file", (s.file for s in shards))):
            twice = repeated(names)
            if twice is not None:
                raise ValueError(f"two shards have the {what} {twice}")
        return shards

    @model_validator(mode="after")
    def _counted(self) -> DatasetManifest:
        beyond = next((shard for shard in self.shards if shard.index >= self.shard_count), None)
        if beyond is not None:
            last = self.shard_count - 1
            raise ValueError(f"'{beyond.file}' is shard {beyond.index}; the shards are numbered 0 to {last}")
        return self


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
    rejected: dict[str, int] = {}
    """Draws of this shard that the plan's rules rejected, by rule."""
    plan: SamplingPlan = SamplingPlan()
    """The resolved sampling plan."""
    preview: tuple[str, ...] = ()
    """Pictures of the first rollouts, files beside the first shard."""
    up_to_date: bool = False
    """The shard was there already, whole, and was kept."""
    notes: tuple[str, ...] = ()


class ShardsSummary(FileModel):
    """What `cgwm synthesize` reports of several shards at once."""

    dataset: str
    shards: int
    made: int
    """Shards that this run made; the others were there already, whole."""
    rollouts: int
    frames: int
    """Labelled camera images of all shards; time steps where there are no cameras."""
    bytes: int
    seconds: float
    frames_per_s: float
    """Of the frames that this run made."""
    rejected: dict[str, int] = {}
    """Draws of all shards that the plan's rules rejected, by rule."""
    plan: SamplingPlan = SamplingPlan()
    """The resolved sampling plan."""
    preview: tuple[str, ...] = ()
    """Pictures of the first rollouts, files beside the first shard."""
    notes: tuple[str, ...] = ()


class MergeSummary(FileModel):
    """What `cgwm merge` reports."""

    index: str
    sha256: str
    bytes: int
    """Of the index itself; the shards stay where they are."""
    shards: int
    rollouts: int
    frames: int
    shard_bytes: int
    up_to_date: bool = False
    """The index was there already, of the same shards, and was kept."""
    notes: tuple[str, ...] = ()
