"""Tests for a missing contact effect: sliding, impacts, and contact segments."""
