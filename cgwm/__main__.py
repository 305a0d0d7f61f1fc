"""Run the command line as ``python -m cgwm``."""

from .cli import main  # pyright: ignore[reportMissingImports]  (installed, it lies in this package)

if __name__ == "__main__":
    main()
