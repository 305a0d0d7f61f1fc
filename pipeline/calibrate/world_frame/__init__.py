"""The metric scale and the axes of the world, from markers, distances, depth maps, or how photos are held."""
