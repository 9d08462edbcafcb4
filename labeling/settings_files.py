"""Settings in YAML: read, laid over one another, and checked against what they should be."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from labeling.errors import ConfigError
from labeling.settings_faults import settings_faults

Model = TypeVar("Model", bound=BaseModel)


class _UniqueKeys(yaml.SafeLoader):
    """Of two values for one setting the last would win without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        twice = [key for n, key in enumerate(keys) if key in keys[:n]]
        if twice:
            raise yaml.constructor.ConstructorError(None, None, f"{twice[0]!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep=deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds a mapping; an empty one holds an empty mapping.

    Raises:
        ConfigError: it cannot be read, is no YAML, or holds something else.
    """
    try:
        # A safe loader all the same: it makes plain values only.
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeys)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); check the path") from error
    # PyYAML lets the errors of its constructors out: a 13th month, a number of 5,000 digits, lists without end.
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
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
