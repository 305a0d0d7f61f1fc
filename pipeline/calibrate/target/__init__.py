"""The calibration target: its sheet to print, and intrinsics from photos of it."""
