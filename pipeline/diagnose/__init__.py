"""Diagnosis: find the physical or measurement effect that a model lacks, and the experiment that would identify it.

`stage` runs it and `verdict` decides. `flight` and `contact` search for effects, whose `evidence` is of one kind;
`next_experiment` ranks throws and motions; `report` puts the verdict into words and on a page.
"""

from .stage import diagnose

__all__ = ["diagnose"]
