"""Stage SG-GS: fit spherical Gaussians to photos and distill the spheres that collide."""

from .stage import SgGsResult, fit_scene

__all__ = ["SgGsResult", "fit_scene"]
