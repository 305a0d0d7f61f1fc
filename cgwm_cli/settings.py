"""From a settings file, `--set` and options to the configuration of a stage. The later wins."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from ..schemas import FileModel

ConfigT = TypeVar("ConfigT", bound="FileModel")


class StageSettings:
    """What the user set for the stages of one command.

    Args:
        stages: The stages that the command runs; settings of others are refused, not passed over.
        file: A TOML file with a table for each stage, or None.
        assignments: `stage.key=value` (or `stage.table.key=value`), as typed after `--set`.

    Raises:
        InputDataError: If the file is wrong.
        UsageError: If an assignment is.
    """

    def __init__(self, stages: Sequence[str], file: Path | None, assignments: Sequence[str] | None) -> None:
        self._stages = list(stages)
        self._values: dict[str, dict[str, Any]] = {stage: {} for stage in stages}
        self._file, self._text = file, ""
        if file is not None:
            self._read(file)
        self._from_file = {stage: dict(values) for stage, values in self._values.items()}
        for assignment in assignments or ():
            self._assign(assignment)

    def configure(self, stage: str, config: type[ConfigT], **options: Any) -> ConfigT:
        """Build the configuration of a stage.

        Args:
            stage: The stage's name.
            config: The model of its configuration.
            **options: Values of the command's own options, which win; None where one was not given.

        Raises:
            InputDataError: If a setting is unknown or out of its range.
        """
        from ..schemas import parse

        if self._file is not None:  # first alone, so that a fault is reported with its file and line
            parse(self._from_file[stage], config, self._file, self._text)
        given = {name: value for name, value in options.items() if value is not None}
        return parse(self._values[stage] | given, config, Path(f"settings of {stage}"))

    def _read(self, file: Path) -> None:
        import tomllib

        from ..schemas import InputDataError

        try:
            self._text = file.read_text(encoding="utf-8")
            document = tomllib.loads(self._text)
        except FileNotFoundError:
            raise InputDataError(f"{file}: no such file.") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputDataError(f"{file}: not valid TOML: {error}.") from None
        for stage, table in document.items():
            self._check_stage(stage, f"{file}: [{stage}]")
            if not isinstance(table, dict):
                raise InputDataError(f"{file}: '{stage}' is no table.", f"[{stage}], and its settings below it.")
            self._values[stage] = table

    def _assign(self, text: str) -> None:
        from ..schemas import UsageError

        key, equals, value = text.partition("=")
        stage, *path = (part.strip() for part in key.split("."))
        if not (equals and stage and path and all(path)):
            example = f"{self._stages[0]}.seed=1"
            raise UsageError(f"--set {text}: not understood.", f"STAGE.KEY=VALUE, for example {example}.")
        self._check_stage(stage, f"--set {text}")
        table = self._values[stage]
        for part in path[:-1]:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise UsageError(f"--set {text}: '{part}' is no table.")
        table[path[-1]] = _value(value.strip())

    def _check_stage(self, stage: str, place: str) -> None:
        from ..schemas import UsageError, did_you_mean

        if stage not in self._stages:
            legal = ", ".join(self._stages)
            found = f"{place}: this command runs no stage '{stage}'."
            raise UsageError(found, f"{legal}.{did_you_mean(stage, self._stages)}")


def _value(text: str) -> Any:
    """Read a value as TOML does (numbers, booleans, lists); anything else is a word."""
    import tomllib

    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
