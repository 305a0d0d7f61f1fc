"""Support for output: files that appear only when complete, progress bars and free space."""
