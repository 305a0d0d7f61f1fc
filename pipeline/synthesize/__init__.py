"""Synthesize datasets of labelled rollouts, in shards on one machine or on a cluster."""

from .merge import merge
from .stage import synthesize

__all__ = ["merge", "synthesize"]
