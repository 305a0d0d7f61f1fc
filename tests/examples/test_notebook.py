"""The notebook: ten cells, each a step of the loop; run by Jupyter in evidence."""

import ast
import json
import os
import subprocess
import sysconfig
import venv
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "loop.ipynb"


def _cells() -> list[str]:
    document = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]


def test_it_has_ten_cells_of_functions_that_exist_and_no_outputs() -> None:
    import cgwm

    cells = _cells()
    assert len(cells) == 10
    called = {
        node.func.attr
        for cell in cells
        for node in ast.walk(ast.parse(cell))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if isinstance(node.func.value, ast.Name) and node.func.value.id == "cgwm"
    }
    assert called == {"calibrate", "fit", "evaluate", "compare", "synthesize", "validate", "export"}
    assert all(callable(getattr(cgwm, name)) for name in called)
    document = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in document["cells"])


@pytest.mark.evidence
def test_jupyter_runs_every_cell(tmp_path: Path) -> None:
    """In an environment with Jupyter's client, which lends the packages of this one."""
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    pip = [python, "-m", "pip", "install", "-q", "nbclient", "nbformat", "ipykernel"]
    subprocess.run(pip, check=True, env=environment)
    site = next((tmp_path / "venv" / "lib").iterdir()) / "site-packages"
    (site / "lent.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    run = (
        "import nbformat, nbclient, sys\n"
        "notebook = nbformat.read(sys.argv[1], 4)\n"
        "nbclient.NotebookClient(notebook, timeout=1800, kernel_name='python3').execute()\n"
        "nbformat.write(notebook, 'run.ipynb')\n"
    )
    done = subprocess.run(
        [python, "-c", run, str(NOTEBOOK)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    cells = [cell for cell in json.loads((tmp_path / "run.ipynb").read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, 11))
    assert "image/png" in json.dumps(cells[8]["outputs"])
