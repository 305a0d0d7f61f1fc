"""Configuration of a stage from a settings file, `--set` and options, each overriding the ones before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from ..schemas import FileModel

ConfigT = TypeVar("ConfigT", bound="FileModel")


class StageSettings:
    """Settings that the user gave for the stages of one command.

    Args:
        stages: The stages that the command runs, with their configurations; settings of other stages are refused.
        file: A TOML file with a table for each stage, or None.
        assignments: `stage.key=value` (or `stage.table.key=value`), as typed after `--set`.

    Raises:
        InputDataError: If the file is wrong.
        UsageError: If an assignment is wrong.
    """

    def __init__(
        self, stages: Mapping[str, type[FileModel]], file: Path | None, assignments: Sequence[str] | None
    ) -> None:
        self._stages = list(stages)
        self._model = _document_model(stages)
        self._values: dict[str, Any] = {}
        self._file, self._assignments = file, tuple(assignments or ())
        if file is not None:
            from ..schemas import read_toml

            self._values = read_toml(file, self._model).model_dump(exclude_unset=True, by_alias=True)
        for assignment in self._assignments:
            self._assign(assignment)

    def configure(self, stage: str, config: type[ConfigT], **options: Any) -> ConfigT:
        """Build the configuration of a stage.

        Args:
            stage: The stage's name.
            config: The model of its configuration.
            **options: Values of the command's options, which override the others; None if not given.

        Raises:
            InputDataError: If a setting is unknown or out of its range.
        """
        from ..schemas import parse

        given = {name: value for name, value in options.items() if value is not None}
        document = {stage: self._values.get(stage, {}) | given}
        return getattr(parse(document, self._model, self._sources(stage)), _attribute(stage))

    def _sources(self, stage: str) -> str:
        """Return where the settings of a stage come from, for messages."""
        sources = [f"--set {text:.80}" for text in self._assignments if text.partition(".")[0].strip() == stage]
        if self._file is not None:
            sources.insert(0, str(self._file))
        return f"settings ({', '.join(sources)})" if sources else "settings"

    def _assign(self, text: str) -> None:
        from ..schemas import UsageError, did_you_mean

        stage, path, value = self._parted(text)
        if stage not in self._stages:
            legal = f"{', '.join(self._stages)}.{did_you_mean(stage, self._stages)}"
            raise UsageError(
                f"--set {text}: this command runs no stage '{stage}'.",
                legal,
                "begin the key with the name of one of these stages.",
            )
        table = self._values
        for part in [stage, *path[:-1]]:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise UsageError(
                    f"--set {text}: '{part}' is not a table.",
                    "STAGE.KEY=VALUE, or STAGE.TABLE.KEY=VALUE for a table.",
                    f"set '{part}' once: as a value, or the keys of a table.",
                )
        table[path[-1]] = _value(value.strip())

    def _parted(self, text: str) -> tuple[str, list[str], str]:
        """Return the stage, the names below it, and the text of the value."""
        from ..schemas import UsageError

        key, equals, value = text.partition("=")
        stage, *path = (part.strip() for part in key.split("."))
        if not (equals and stage and path and all(path)):
            raise UsageError(
                f"--set {text}: not a setting.",
                f"STAGE.KEY=VALUE, for example {self._stages[0]}.seed=1.",
                "write it as in the example.",
            )
        return stage, path, value


def _document_model(stages: Mapping[str, type[FileModel]]) -> type[FileModel]:
    from pydantic import Field, create_model

    from ..schemas import FileModel

    fields: dict[str, Any] = {
        _attribute(stage): (config, Field(default=config(), alias=stage)) for stage, config in stages.items()
    }
    return create_model("Settings", __base__=FileModel, **fields)


def _attribute(stage: str) -> str:
    return stage.replace("-", "_")


def _value(text: str) -> Any:
    """Parse a value as TOML (numbers, booleans, lists); anything else is a string."""
    import tomllib

    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # a number of thousands of digits, brackets without end
        return text
