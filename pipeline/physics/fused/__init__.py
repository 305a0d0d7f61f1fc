"""Simulation in one CUDA kernel, which keeps the state in registers from the first frame to the last."""

from .rollout import simulate_fused, unsupported

__all__ = ["simulate_fused", "unsupported"]
