"""What the command line says of words that it cannot take, in one line like all other errors. Light to import."""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer

_PARSER_ERROR = "ClickException"


def parser_error(known: type[Exception]) -> type[Exception]:
    """The class that all errors of the parser are of, found by its name above one of them that typer does show.

    Raises:
        ImportError: it is called otherwise, or does not say itself what is wrong.
    """
    for above in known.__mro__:
        if above.__name__ == _PARSER_ERROR and issubclass(above, Exception) and hasattr(above, "format_message"):
            return above
    raise ImportError(
        f"this typer's {known.__name__} is no {_PARSER_ERROR} with a format_message, so errors of the command line "
        "could not be told; install the typer that constraints.txt names"
    )


USAGE_ERRORS = parser_error(typer.BadParameter)
"""What the parser raises, wherever this typer keeps click's errors."""


def print_usage_error(error: Exception) -> None:
    """One line on standard error: what is wrong, and where to look."""
    words: Any = error
    text = " ".join(words.format_message().split()).rstrip(".")
    if type(error).__name__ == "NoArgsIsHelpError":
        # The help has been shown instead of an error.
        print(text, file=sys.stderr, end="\n" * bool(text))
        return
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "animatic"
    between = "" if text.endswith("?") else ";"
    line = f"{text[:1].lower()}{text[1:]}{between} `{command} --help` says what there is"
    typer.echo(f"{typer.style('error:', fg='red', bold=True)} {line}", err=True)


def refuse_empty_paths(app: typer.Typer, words: Sequence[str]) -> None:
    """Raise for an empty word in a path's place: an unset variable would name the folder that one stands in.

    Args:
        app: the command line.
        words: after the program's name.

    Raises:
        ConfigError: an option that takes a path, or an argument, is empty.
    """
    if not any(word == "" or word.endswith("=") for word in words):
        return
    from labeling.errors import ConfigError

    kinds = dict(_options(app))
    for before, word in zip(("", *words), words, strict=False):
        if word == "--":
            return
        name = before if word == "" else word.removesuffix("=")
        is_value = word == "" and before in kinds
        if (is_value or word == f"{name}=") and kinds.get(name, False):
            raise ConfigError(f"{name} is empty; give a path (is a variable unset?)")
        if word == "" and not is_value:
            raise ConfigError("an argument is empty; give a path or a name (is a variable unset?)")


def _options(app: typer.Typer) -> Iterator[tuple[str, bool]]:
    """Every option of every command that takes a value, and whether that is a path somewhere; paths come last."""
    found = [
        (name, Path in _plain_types(hint))
        for function in _functions(app)
        for parameter, hint in get_type_hints(function, include_extras=True).items()
        if (names := _option_names(parameter, hint)) and bool not in _plain_types(hint)
        for name in names
    ]
    yield from sorted(found, key=lambda option: option[1])


def _functions(app: typer.Typer) -> Iterator[Any]:
    groups = [group.typer_instance for group in app.registered_groups if group.typer_instance is not None]
    callback = getattr(app.registered_callback, "callback", None)
    yield from ([callback] if callback is not None else [])
    yield from (command.callback for command in app.registered_commands if command.callback is not None)
    for group in groups:
        yield from _functions(group)


def _option_names(parameter: str, hint: Any) -> list[str]:
    for mark in get_args(hint)[1:]:
        if type(mark).__name__ == "OptionInfo":
            # Of an annotation's names typer takes the first for the default.
            words = (mark.default, *(mark.param_decls or ()))
            given = [word for word in words if isinstance(word, str) and word.startswith("-")]
            return given or [f"--{parameter.replace('_', '-')}"]
    return []


def _plain_types(hint: Any) -> set[Any]:
    """``Path`` and ``None`` of ``Annotated[Path | None, ...]``."""
    parts = get_args(hint)
    return {kind for part in parts for kind in _plain_types(part)} if parts else {hint}
