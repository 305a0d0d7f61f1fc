"""Photos of what turns before a camera that stands: its motion, cameras, points, and features that do not turn."""
