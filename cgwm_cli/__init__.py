"""The command `cgwm`: a small module for each verb, no numerics. Each verb calls one function of the pipeline.

Only the standard library and typer are imported here, so that ``cgwm --help`` answers at once; everything else is
imported inside the commands.
"""

from .run import main

__all__ = ["main"]
