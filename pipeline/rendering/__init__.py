"""Spherical Gaussians: rendering, fitting to photos, and the spheres that collide."""
