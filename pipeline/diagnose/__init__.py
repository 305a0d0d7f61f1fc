"""Diagnosis: find the physical or measurement effect that a model lacks, and the experiment that would identify it.

`stage` runs it; `verdict` decides; `flight_search` and `contact_search` select effects; `contact_tests` holds the tests
in contact; `next_experiment` ranks experiments.
"""

from .stage import diagnose

__all__ = ["diagnose"]
