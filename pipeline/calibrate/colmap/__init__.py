"""Adapter of pycolmap: features, matches, cameras and points, repeatable bit for bit."""
