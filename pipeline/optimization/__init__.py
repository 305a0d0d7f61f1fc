"""Least squares with exact forward-mode derivatives, and the uncertainty of what it finds."""
