"""Fixed surfaces: shapes, meshes, their contacts with spheres, and walls that a body could pass."""
