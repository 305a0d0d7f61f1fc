"""Sliding segments: what they are, and the fit of friction and effects to them."""
