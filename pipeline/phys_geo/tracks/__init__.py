"""Fit the contact model to measured tracks."""
