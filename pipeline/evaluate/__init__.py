"""Predict episodes in open loop and measure the errors of poses and images."""

from .stage import evaluate

__all__ = ["evaluate"]
