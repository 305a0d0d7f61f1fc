"""Render spherical Gaussians: images, depth, masks and labels, on the CPU in torch and on CUDA devices."""
