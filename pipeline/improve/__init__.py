"""Improvement: fit, diagnose, add and refit until no addition predicts unseen episodes better.

`stage` runs it; `ladder` decides; `folds` and `held_out_errors` judge; `test_split` opens the test split; `page` tells.
"""

from .stage import improve

__all__ = ["improve"]
