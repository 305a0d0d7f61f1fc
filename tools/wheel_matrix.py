"""Check that every dependency has a wheel for other versions of Python: nothing is compiled where cgwm is installed.

    python tools/wheel_matrix.py [--python 3.12,3.13,3.14] [--extras view,usd,...]

pip resolves the requirements of `pyproject.toml` for each version without installing anything; it reads markers such as
`python_version` as those of the running Python, so that cgwm's own are evaluated here for the version that is asked
for. Markers of the dependencies' own requirements stay those of the running Python. Needs a package index.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
EXTRAS = ("view", "usd", "heif", "ros", "lerobot", "rerun")
SHOWN = ("torch", "numpy", "scipy", "mujoco", "h5py", "pycolmap", "opencv-python-headless")


def requirements(version: str, extras: list[str]) -> list[str]:
    """Return the requirements of cgwm with some extras for a version of Python, without markers."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [*project["dependencies"], *(line for extra in extras for line in project["optional-dependencies"][extra])]
    environment = {"python_version": version, "python_full_version": f"{version}.0"}
    found = [Requirement(line) for line in lines]
    chosen = [one for one in found if one.marker is None or one.marker.evaluate(environment)]
    return [f"{one.name}{one.specifier}" for one in chosen]


def resolved(version: str, wanted: list[str]) -> dict[str, str] | str:
    """Return the version of each package that pip would install, or what it says where it finds none."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--target", folder, "--python-version", version, "--only-binary=:all:", "--report", str(report)]
        done = subprocess.run([*command, *wanted], capture_output=True, text=True, check=False)
        if done.returncode:
            return next((line for line in done.stderr.splitlines() if line.startswith("ERROR")), done.stderr[-300:])
        packages = [one["metadata"] for one in json.loads(report.read_text(encoding="utf-8"))["install"]]
        return {one["name"].lower(): one["version"] for one in packages}


def main() -> int:
    """Print a line for each version of Python; return 1 if one has no wheels for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default="3.11,3.12,3.13,3.14")
    parser.add_argument("--extras", default=",".join(EXTRAS))
    arguments = parser.parse_args()
    failed = False
    for version in arguments.python.split(","):
        found = resolved(version, requirements(version, [name for name in arguments.extras.split(",") if name]))
        failed |= isinstance(found, str)
        shown = found if isinstance(found, str) else ", ".join(f"{name} {found[name]}" for name in SHOWN)
        print(f"{version}: {'' if isinstance(found, str) else f'{len(found)} wheels; '}{shown}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
