"""What is wrong with settings, in words: the field, the value, and what is allowed."""

import math
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

_ALLOWED = {
    "greater_than": "be above {gt:g}", "greater_than_equal": "be {ge:g} or more", "less_than": "be below {lt:g}",
    "less_than_equal": "be {le:g} or less", "literal_error": "be {expected}", "finite_number": "be finite",
    "int_type": "be a whole number", "int_parsing": "be a whole number", "int_from_float": "be a whole number",
    "float_type": "be a number", "float_parsing": "be a number", "bool_type": "be true or false",
    "bool_parsing": "be true or false", "string_type": "be text", "tuple_type": "be a list", "list_type": "be a list",
    "model_type": "hold settings by name", "model_attributes_type": "hold settings by name",
    "dict_type": "hold values by name",
}  # fmt: skip
"""By pydantic's types of errors."""


def settings_faults(model: type[BaseModel], error: ValidationError) -> str:
    """Every wrong field of settings, with semicolons between them.

    Args:
        model: what the settings should have been.
        error: what pydantic says of them.
    """
    return "; ".join(_fault(model, fault) for fault in error.errors())


def _fault(model: type[BaseModel], fault: Any) -> str:
    place, kind = ".".join(str(part) for part in fault["loc"]) or "settings", fault["type"]
    if kind == "extra_forbidden":
        return f"{place} is not a setting; {_advice(str(fault['loc'][-1]), _neighbours(model, fault['loc']))}"
    if kind == "missing":
        return f"{place} is missing; it has no default, so give it"
    if isinstance(fault["input"], float) and math.isnan(fault["input"]):
        return f"{place} is nan, but must be a number"
    if kind in _ALLOWED:
        return f"{place} is {fault['input']!r}, but must {_ALLOWED[kind].format(**fault.get('ctx', {}))}"
    return f"{place}: {fault['msg'].lower().removeprefix('value error, ')}, got {fault['input']!r}"


def _advice(name: str, known: Sequence[str]) -> str:
    """What to write instead of an unknown field: what it may have been meant to be, and all that there are."""
    meant = " or ".join(get_close_matches(name, known, n=2, cutoff=0.7))
    return (f"did you mean {meant}? " if meant else "") + f"choose one of {', '.join(known) or 'none'}"


def _neighbours(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """The fields that there are where an unknown one was given."""
    known: Any = model
    for part in place[:-1]:
        fields = getattr(_model_in(known), "model_fields", {})
        # A part that is no field is a key of a mapping, and what it holds is of the same kind for all keys.
        known = fields[part].annotation if part in fields else known
    return list(getattr(_model_in(known), "model_fields", ()))


def _model_in(annotation: Any) -> Any:
    """The settings in ``Settings``, ``Settings | None`` or ``dict[str, Settings]``; None where there are none."""
    if hasattr(annotation, "model_fields"):
        return annotation
    return next((found for part in get_args(annotation) if (found := _model_in(part)) is not None), None)
