"""Messages about wrong usage of the command line."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any


def explain(error: Any, arguments: list[str]) -> str:
    """Format a usage error of typer as our messages: what was found, what is allowed, what to do next."""
    from ..schemas import UsageError

    context = getattr(error, "ctx", None)
    command = context.command_path if context else "cgwm"
    todo = f"run '{command} --help'."
    if type(error).__name__ == "NoArgsIsHelpError":
        return error.format_message()
    option = getattr(error, "option_name", None)
    if option is not None and type(error).__name__ == "NoSuchOption":
        return _none_called(command, "option", option, _options(context))
    message = _sentence(error.format_message().replace("Value error, ", ""))
    if message.startswith("No such command"):
        before = len(command.split()) - 1  # words of the group that should have the verb
        verb = next((word for word in arguments[before:] if not word.startswith("-")), "")
        return _none_called(command, "command", verb, list(getattr(context.command, "commands", {})) if context else [])
    parameter = getattr(error, "param", None)
    if context and type(error).__name__ == "MissingParameter" and getattr(parameter, "nargs", 1) == -1:
        # of "MODEL... CAPTURE" a single path is taken for the last, although the first was meant
        needed = " and ".join(_arguments(context))
        return str(UsageError(f"{command}: {needed} are needed; one of them is missing.", todo=todo))
    return str(UsageError(f"{command}: {message}{_nearest_choice(message)}", todo=todo))


def _none_called(command: str, kind: str, name: str, legal: list[str]) -> str:
    """Return the message about an option or a command that does not exist."""
    from ..schemas import UsageError, did_you_mean

    found, allowed = f"{command}: there is no {kind} '{name}'.", f"{', '.join(legal)}.{did_you_mean(name, legal)}"
    return str(UsageError(found, allowed, f"run '{command} --help'."))


def _arguments(context: Any) -> list[str]:
    """Return what the help calls the arguments of a command."""
    return [str(one.metavar or one.name) for one in context.command.params if one.param_type_name == "argument"]


def refuse_foreign(given: Iterable[str], legal: Iterable[str], where: str, todo: str = "") -> None:
    """Refuse options of a verb that do not apply to one of its formats.

    Args:
        given: Names of the arguments that were given; an option is named like its argument, without its unit.
        legal: Names of the arguments that apply.
        where: The format or option that they were given with, for the message.
        todo: What to do next.

    Raises:
        UsageError: If an option does not apply.
    """
    from ..schemas import UsageError

    options = [option_name(name) for name in legal]
    for name in given:
        if option_name(name) not in options:
            allowed = ", ".join(options) or "no format-specific option"
            raise UsageError(f"{option_name(name)} does not apply to {where}.", f"{allowed}.", todo)


def option_name(name: str) -> str:
    """Return the name of the option of an argument, without its unit."""
    return "--" + name.removesuffix("_s").replace("_", "-")


def _nearest_choice(message: str) -> str:
    """Suggest the allowed value that is most similar to a wrong one, from a message that quotes both."""
    from ..schemas import did_you_mean

    found, is_choice, legal = message.partition(" is not one of ")
    return did_you_mean(re.findall("'([^']*)'", found)[-1], re.findall("'([^']*)'", legal)) if is_choice else ""


def _options(context: Any) -> list[str]:
    options = [name for parameter in context.command.params for name in parameter.opts if name.startswith("-")]
    return [*sorted(name for name in options if name.startswith("--")), "--help"]


def _sentence(message: str) -> str:
    message = " ".join(message.split())
    return message if message.endswith((".", "?", "!")) else message + "."
