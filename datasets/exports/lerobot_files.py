"""File names of LeRobot v3 (`chunk-000/file-000`), and its parquet and JSON files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import InputDataError

FILES_PER_CHUNK = 1000


def require_packages() -> None:
    """Raise InputDataError unless pyarrow and av are installed."""
    try:
        import av  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise InputDataError(
            f"--to lerobot needs the package '{error.name}', which is not installed.",
            todo="pip install 'cgwm[lerobot]', or: pip install pyarrow av",
        ) from None


@dataclass
class FilePlaces:
    """Number of a file and of its chunk."""

    chunk: int = 0
    file: int = 0

    def advance(self) -> None:
        """Advance to the next file."""
        self.chunk, self.file = divmod(self.chunk * FILES_PER_CHUNK + self.file + 1, FILES_PER_CHUNK)

    def name(self, suffix: str) -> str:
        """Return the file's name below its folder."""
        return f"chunk-{self.chunk:03d}/file-{self.file:03d}{suffix}"

    def columns(self, prefix: str) -> dict[str, int]:
        """Return the columns that name the file."""
        return {f"{prefix}/chunk_index": self.chunk, f"{prefix}/file_index": self.file}


def write_frames(path: Path, columns: Mapping[str, np.ndarray], features: Mapping[str, Mapping[str, Any]]) -> None:
    """Write frames as parquet: vectors as lists of fixed length, with the types given by the features."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {}
    for name, values in columns.items():
        kind, width = pa.type_for_alias(features[name]["dtype"]), features[name]["shape"][0]
        flat = pa.array(np.ascontiguousarray(values).ravel(), kind)
        # LeRobot stores a feature of shape (1,) as a scalar
        arrays[name] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(arrays), path, compression="snappy")


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of numbers, strings and nested lists as parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    plain = [
        {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in r.items()} for r in rows
    ]
    pq.write_table(pa.Table.from_pylist(plain), path, compression="snappy")


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks as a table whose pandas index is the description."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "__index_level_0__": list(tasks)})
    index = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"}
    column = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    about = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [{**column, "metadata": None}, {**index, "metadata": None}],
        "creator": {"library": "pyarrow", "version": pa.__version__},
    }
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)


def write_json(path: Path, content: Any) -> None:
    """Write JSON, with arrays as lists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=1, default=lambda value: value.tolist())
    path.write_text(text + "\n", encoding="utf-8")
