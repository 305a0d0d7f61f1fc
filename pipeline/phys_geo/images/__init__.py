"""Fit the contact model to videos: pose tracking, image losses and end-to-end refinement."""
