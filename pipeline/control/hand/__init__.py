"""Hands: what their controller, plant, runs and films have of their own."""
