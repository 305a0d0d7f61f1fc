"""Measured motion: observations with their noise, residuals of rollouts, and segmentation into flight and contact."""
