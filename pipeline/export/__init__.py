"""Export of models and datasets to the formats of other software."""

from .stage import export

__all__ = ["export"]
