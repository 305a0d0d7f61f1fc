"""What all tests share."""

import os

# Tests start commands in processes of their own, from the repository's root. Without this Python puts that directory
# first on the path, and finds the folder cgwm/ there instead of the installed package.
os.environ["PYTHONSAFEPATH"] = "1"
