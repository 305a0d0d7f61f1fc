"""Matches that are found in processes of their own are those that are found here."""

import sqlite3
import time

import numpy as np
import pycolmap
import pytest
from cgwm.pipeline.calibrate.colmap.match_pairs import match_apart, match_pairs

SETTINGS = {"seed": 0, "guided_matching": False, "max_ratio": 0.8, "verification_trials": 200}
NAMES, FEATURES = ("a.jpg", "b.jpg", "c.jpg"), 600  # as many as are compared by a BLAS: from 512 on
PAIRS = (NAMES[:2], NAMES[1:])


def database(path):
    """Write features of three views of random points in a plane, with the noise of descriptors."""
    rng = np.random.default_rng(0)
    places, looks = rng.uniform(50, 450, (FEATURES, 2)), rng.integers(0, 80, (FEATURES, 128))
    opened = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 500, 500)
    opened.write_camera(camera, use_camera_id=True)
    for number, name in enumerate(NAMES, 1):
        opened.write_image(pycolmap.Image(name=name, camera_id=1, image_id=number), use_image_id=True)
        scale = 1 + 0.1 * number
        opened.write_keypoints(number, (scale * places + 10 * number).astype(np.float32))
        noisy = (looks + rng.integers(0, 12, looks.shape)).astype(np.uint8)
        opened.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, noisy))
    opened.close()
    return path


def rows(path):
    with sqlite3.connect(path) as opened:
        return [opened.execute(f"SELECT * FROM {name}").fetchall() for name in ("matches", "two_view_geometries")]


def test_a_process_of_its_own_finds_the_same_matches(tmp_path):
    token = pycolmap.CancellationToken()
    here, apart = database(tmp_path / "here.db"), database(tmp_path / "apart.db")
    match_pairs(here, PAIRS, SETTINGS, token)
    match_apart(apart, PAIRS, SETTINGS, token)
    assert rows(apart) == rows(here)
    assert min(matches[1] for matches in rows(here)[0]) > FEATURES / 2


def test_a_process_that_fails_is_said_and_one_that_is_cancelled_ends(tmp_path):
    token = pycolmap.CancellationToken()
    (tmp_path / "broken.db").write_bytes(b"no database" * 99)
    with pytest.raises(RuntimeError, match="COLMAP's matching ended with code"):
        match_apart(tmp_path / "broken.db", PAIRS, SETTINGS, token)
    token.cancel()
    started = time.monotonic()
    match_apart(tmp_path / "broken.db", PAIRS, SETTINGS, token)
    assert time.monotonic() - started < 5
