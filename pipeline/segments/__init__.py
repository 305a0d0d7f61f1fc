"""Segments of measured motion with fitted states: flights, sliding segments, impacts and first contacts."""
