"""Geometry kernels: rotations, meshes, solids and unions of spheres."""
