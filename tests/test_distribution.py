"""The wheel that is built from the source archive, installed into an environment of its own and run without network."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CONDA = {"torch": "pytorch", "mujoco": "mujoco-python", "opencv-python-headless": "py-opencv"}


def test_the_conda_recipe_asks_for_what_the_project_asks_for() -> None:
    recipe = (ROOT / "packaging/conda/recipe.yaml").read_text(encoding="utf-8")
    for requirement in PROJECT["project"]["dependencies"]:
        name, bounds = re.fullmatch(r"([A-Za-z0-9.-]+)([^;]*)(?:;.*)?", requirement).groups()  # pyright: ignore[reportOptionalMemberAccess]
        if name != "cuda-core":  # optional: without it a GPU renders with torch
            assert f"    - {CONDA.get(name, name)} {bounds.strip()}\n" in recipe, requirement
    assert f'version: "{PROJECT["project"]["version"]}"' in recipe


@pytest.mark.evidence
def test_the_conda_recipe_renders() -> None:
    rattler = pytest.importorskip("rattler_build", reason="reads recipes: pip install py-rattler-build")
    recipe = rattler.Stage0Recipe.from_file(ROOT / "packaging/conda/recipe.yaml")
    (found,) = recipe.render(rattler.VariantConfig())
    assert str(found.recipe.package.name) == "cgwm"


def test_the_dockerfile_copies_every_package() -> None:
    text = (ROOT / "packaging/Dockerfile").read_text(encoding="utf-8")
    for folder in PROJECT["tool"]["setuptools"]["package-dir"].values():
        assert f"COPY {folder} /source/{folder}\n" in text
    assert set(PROJECT["project"]["optional-dependencies"]) >= {"view", "heif"}


def _run(*words: str | Path, **options: object) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False, **options)  # pyright: ignore[reportCallIssue, reportArgumentType]
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _without_network() -> list[str]:
    """Return what runs a command without network interfaces, where this machine admits it."""
    words = ["unshare", "--user", "--map-root-user", "--net"]
    works = (
        shutil.which("unshare") and not subprocess.run([*words, "true"], capture_output=True, check=False).returncode
    )
    return words if works else []


@pytest.mark.evidence
def test_the_wheel_runs_without_the_repository_and_without_network(tmp_path: Path) -> None:
    """Its dependencies are those of this environment, which a file `.pth` lends."""
    source, dist = tmp_path / "source", tmp_path / "dist"
    names = ("cgwm", "cgwm_cli", "datasets", "pipeline", "schemas", "pyproject.toml", "README.md", "LICENSE")
    source.mkdir()
    for name in names:
        part = ROOT / name
        (shutil.copytree if part.is_dir() else shutil.copy)(part, source / name)  # pyright: ignore[reportCallIssue]
    build = "from setuptools import build_meta; import sys; build_meta.build_sdist(sys.argv[1])"
    _run(sys.executable, "-c", build, dist, cwd=source)
    (archive,) = dist.glob("*.tar.gz")
    pip = ("-m", "pip", "--disable-pip-version-check")
    flags = ("--no-deps", "--no-index")
    _run(sys.executable, *pip, "wheel", "-q", *flags, "--no-build-isolation", "--wheel-dir", dist, archive)
    (wheel,) = dist.glob("*.whl")
    _run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    _run(python, *pip, "install", "-q", *flags, wheel)
    site = Path(_run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {key: value for key, value in os.environ.items() if key in ("PATH", "LANG")}
    environment |= {"HOME": str(tmp_path / "home"), "PIP_NO_INDEX": "1"}
    (tmp_path / "home").mkdir()

    def cgwm(*words: str | Path) -> str:
        return _run(*_without_network(), tmp_path / "venv/bin/cgwm", *words, cwd=tmp_path / "home", env=environment)

    where = _run(python, "-c", "import cgwm; print(cgwm.__file__)", cwd=tmp_path / "home", env=environment)
    assert Path(where.strip()).is_relative_to(site)
    assert cgwm("--version").startswith("cgwm ")
    assert "ready." in cgwm("doctor")
    assert "quadratic_drag" in cgwm("effects", "list")
    (tmp_path / "home" / "poses.txt").write_text(
        "".join(f"{0.01 * k:.2f} 0 0 {1 - 0.5 * 9.81 * (0.01 * k) ** 2:.6f} 0 0 0 1\n" for k in range(30))
    )
    cgwm("import", "tum", "poses.txt", "--out", "capture")
    cgwm("validate", "capture")
