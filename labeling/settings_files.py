"""Settings in YAML: read, laid over one another, and checked against what they should be."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from labeling.errors import ConfigError
from labeling.settings_faults import settings_faults

Model = TypeVar("Model", bound=BaseModel)


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds a mapping; an empty one holds an empty mapping.

    Raises:
        ConfigError: it cannot be read, is no YAML, or holds something else.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); check the path") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: is no YAML ({' '.join(str(error).split())}); mend it") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: needs a mapping of settings, holds {type(values).__name__}")
    return values


def laid_over(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values with changes laid over them: mappings are merged, anything else is replaced."""
    result = dict(values)
    for name, change in changes.items():
        nested = isinstance(change, Mapping) and isinstance(result.get(name), Mapping)
        result[name] = laid_over(result[name], change) if nested else change
    return result


def parse_settings(model: type[Model], values: Mapping[str, Any], name: str) -> Model:
    """Settings from plain values.

    Args:
        model: what they should be.
        values: nested, by field.
        name: of the file or section, as an error shows it.

    Raises:
        ConfigError: an unknown key, or a value out of range, with its path.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(f"{name}: {settings_faults(model, error)}") from error
