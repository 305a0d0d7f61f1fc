"""Jointed bodies: links in a tree, their motion, and the rows of their joints in the contact solver."""
