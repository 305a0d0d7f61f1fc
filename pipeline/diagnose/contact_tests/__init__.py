"""Tests for a missing contact effect: sliding, impacts, friction consistency, and contact segments."""
