"""Run the command line as ``python -m cgwm``."""

from .cli import main

if __name__ == "__main__":
    main()
