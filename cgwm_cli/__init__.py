"""The command `cgwm`."""
def main() -> None:
    """Run."""
