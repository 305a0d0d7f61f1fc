"""Fit the parameters of named effects, each from the kind of motion that identifies it."""
