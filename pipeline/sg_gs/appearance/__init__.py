"""Visual spheres: where a fit begins, its losses, its descent, and the colours of what is fitted."""
