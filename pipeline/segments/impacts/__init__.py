"""Impacts: velocities on both sides, bounces of balls, and the fits of restitution and friction to them."""
