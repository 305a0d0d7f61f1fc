"""Importers of recordings in other formats: one module per format."""
