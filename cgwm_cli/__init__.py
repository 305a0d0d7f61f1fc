"""The command `cgwm`: one small module per verb, without numerics. Each verb calls one function of the pipeline.

Only the standard library and typer are imported at module level, so that ``cgwm --help`` answers at once; everything
else is imported inside the commands.
"""

from .main import main

__all__ = ["main"]
