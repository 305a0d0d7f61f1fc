"""Detection of ArUco markers in photos."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ....schemas import InputDataError, did_you_mean
from ..reconstruction import Array

_PREFIX = "DICT_"


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's predefined dictionary by its name without the prefix `DICT_`.

    Raises:
        InputDataError: If no dictionary has that name; the message has the nearest one.
    """
    legal = sorted(key.removeprefix(_PREFIX) for key in dir(cv2.aruco) if key.startswith(_PREFIX))
    if name not in legal:
        raise InputDataError(
            f"capture.toml: calibration.aruco_dictionary: unknown dictionary '{name}'.",
            ", ".join(legal) + "." + did_you_mean(name, legal),
            "name the dictionary that the markers were printed from.",
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _PREFIX + name))


def marker_corners(side_m: float) -> Array:
    """Return the corners of a marker in the marker frame [m], shape (4, 3).

    The frame: origin at the centre, x right and y up as printed, z out of the paper. The order is OpenCV's: top
    left, top right, bottom right, bottom left.
    """
    half = 0.5 * side_m
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def detect_markers(image: NDArray[np.uint8], aruco: cv2.aruco.Dictionary) -> dict[int, Array]:
    """Detect markers in a photo.

    Args:
        image: RGB, shape (height, width, 3), as stored (not undistorted).
        aruco: The dictionary.

    Returns:
        Corner pixels by marker id, shape (4, 2), with subpixel accuracy; the centre of the top-left pixel is at
        (0.5, 0.5), where OpenCV has (0, 0). An id that occurs twice is omitted as ambiguous.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(aruco, parameters)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    corners, identifiers, _ = detector.detectMarkers(grey)
    if identifiers is None:
        return {}
    seen = [int(value) for value in np.ravel(identifiers)]
    return {
        identifier: np.asarray(corner, dtype=float).reshape(4, 2) + 0.5
        for identifier, corner in zip(seen, corners, strict=True)
        if seen.count(identifier) == 1
    }
