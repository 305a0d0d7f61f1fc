"""A search for poses in videos with few orientations and steps: for tests in which it matters not how good it is."""

import pytest
from cgwm.pipeline.phys_geo.images import pose_search, pose_tracking
from cgwm.pipeline.phys_geo.tracks import contact_shooting


def search_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for poses in two frames, among few orientations, and shoot the contact in one step."""
    monkeypatch.setattr(contact_shooting, "SHOT_ITERATIONS", 1)
    monkeypatch.setattr(pose_tracking, "KEYFRAMES", 2)
    monkeypatch.setattr(pose_tracking, "BEAM", 1)
    monkeypatch.setattr(pose_tracking, "POLISH_ITERATIONS", 2)
    monkeypatch.setattr(pose_tracking, "CARRY_ITERATIONS", 2)
    monkeypatch.setattr(pose_search, "ROTATIONS", 36)
    monkeypatch.setattr(pose_search, "KEPT", 2)
