"""Shapes on disk: meshes and spherical Gaussians."""
