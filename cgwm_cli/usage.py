"""What is said when a command was typed in a way that it cannot be."""

from __future__ import annotations

from typing import Any


def explain(error: Any, arguments: list[str]) -> str:
    """Put one of typer's usage errors into the three parts of our messages: found, allowed, what to do next."""
    from ..schemas import UsageError, did_you_mean

    context = getattr(error, "ctx", None)
    command = context.command_path if context else "cgwm"
    todo = f"run '{command} --help'."
    if type(error).__name__ == "NoArgsIsHelpError":
        return error.format_message()
    option = getattr(error, "option_name", None)
    if option is not None and type(error).__name__ == "NoSuchOption":
        legal = _options(context)
        found = f"{command}: there is no option '{option}'."
        return str(UsageError(found, f"{', '.join(legal)}.{did_you_mean(option, legal)}", todo))
    verbs = list(getattr(context.command, "commands", {})) if context else []
    message = _sentence(error.format_message())
    if message.startswith("No such command"):
        verb = next((word for word in arguments if not word.startswith("-")), "")
        found = f"{command}: there is no command '{verb}'."
        return str(UsageError(found, f"{', '.join(verbs)}.{did_you_mean(verb, verbs)}", todo))
    return str(UsageError(f"{command}: {message}", todo=todo))


def _options(context: Any) -> list[str]:
    options = [name for parameter in context.command.params for name in parameter.opts if name.startswith("-")]
    return [*sorted(name for name in options if name.startswith("--")), "--help"]


def _sentence(message: str) -> str:
    message = " ".join(message.split())
    return message if message.endswith((".", "?", "!")) else message + "."
