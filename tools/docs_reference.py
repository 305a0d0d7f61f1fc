"""Write the pages of the API reference: a hook of mkdocs, used by `make docs`.

The rooms are separate folders in the source tree and one package, `cgwm`, once installed. The hook copies them into
one package below `build/docs-source/` (mkdocstrings does not follow links), where the reference is drawn from the
docstrings without importing anything. Each package whose `__init__` has an `__all__` gets a page with these names.
"""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "build" / "docs-source"
ROOMS = {"cgwm_cli": "cli", "schemas": "schemas", "datasets": "datasets", "pipeline": "pipeline"}
"""Folders of the source tree and their names inside the package."""
MARKUP = ((r":(?:mod|class|meth|func|attr|data):(?=`)", ""), (r"\] \[", "]&nbsp;["))
"""What Markdown would show as text, or take for a link: roles of Sphinx, and two brackets in a row (`[px] [1]`)."""
SEARCH = "https://unpkg.com/iframe-worker/shim"
"""The script that the search needs in pages opened from disk; the site has its own copy."""


def copy_package() -> Path:
    """Copy the source tree as one package `cgwm`, and return it."""
    package = SOURCE / "cgwm"
    shutil.rmtree(SOURCE, ignore_errors=True)
    for folder, name in {"cgwm": "", **ROOMS}.items():
        shutil.copytree(ROOT / folder, package / name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    for path in package.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for pattern, replacement in MARKUP:
            text = re.sub(pattern, replacement, text)
        path.write_text(text, encoding="utf-8")
    return package


def public_packages(package: Path) -> dict[str, list[str]]:
    """Return the packages with an `__all__` by import name, each with its public names."""
    found = {}
    for init in sorted(package.rglob("__init__.py")):
        names = _names_in_all(init)
        if names:
            found[".".join(init.parent.relative_to(SOURCE).parts)] = names
    return found


def page_of(name: str, public: list[str]) -> str:
    """Return the page of a package: its docstring, then each public name."""
    lines = [f"# {name}", "", f"::: {name}", "    options: {members: false, show_root_heading: false}", ""]
    for one in public:
        if one != "__version__":
            lines += [f"::: {name}.{one}", ""]
    return "\n".join(lines)


def on_config(config: Any) -> Any:
    """Add the reference to the navigation."""
    packages = public_packages(copy_package())
    pages = [{name.removeprefix("cgwm."): f"api/{name}.md"} for name in packages]
    config["nav"] = [*config["nav"], {"Reference": pages}]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    for name, public in public_packages(SOURCE / "cgwm").items():
        files.append(File.generated(config, f"api/{name}.md", content=page_of(name, public)))
    return files


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Let a page load the site's own copy of the search script."""
    return output.replace(SEARCH, "../" * page.url.count("/") + "site/iframe-worker.js")


def _names_in_all(init: Path) -> list[str]:
    for node in ast.parse(init.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            return list(ast.literal_eval(node.value))
    return []
