"""Datasets of rollouts on disk: HDF5 shards, their manifest, index, writer and loader."""

from .loader import RolloutDataset, RolloutReader

__all__ = ["RolloutDataset", "RolloutReader"]
