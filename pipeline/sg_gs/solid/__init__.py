"""The solid of a body from its silhouettes: visual hull, refinement by photo-consistency, flat faces."""
