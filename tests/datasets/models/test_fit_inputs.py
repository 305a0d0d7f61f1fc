"""What a fit is made of, and what has changed since."""

from pathlib import Path

from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.fit_inputs import changed_since_fit, input_hashes
from cgwm.schemas import Provenance
from helpers.thrown_cube import write_capture


def test_a_manifest_that_changed_since_the_fit_is_said_of_the_same_capture_alone(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture")
    capture = Capture.open(root)
    made = Provenance(capture="capture", input_sha256=input_hashes(capture, "test", None, (), {}))
    assert changed_since_fit(made, capture) == []
    with (root / "capture.toml").open("a") as file:
        file.write("\n# a remark\n")
    (text,) = changed_since_fit(made, capture)
    assert text.startswith(f"{root / 'capture.toml'} has changed since the model was fitted")
    for track in (root / "tracks").glob("*.csv"):  # another capture, with episodes of the same names
        track.write_text(track.read_text() + "\n")
    assert changed_since_fit(made, capture) == []
    assert changed_since_fit(Provenance(capture="capture"), capture) == []
