"""Spheres that collide: distilled from solids, and from the links of jointed bodies."""
