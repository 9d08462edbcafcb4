"""Settings in YAML: what is no setting is one line."""

from pathlib import Path

import pytest

from labeling.errors import ConfigError
from labeling.settings_files import laid_over, read_yaml


@pytest.mark.parametrize(
    "text",
    [
        "day: 2024-13-45", "a: !!int abc", "a: !!float abc", "a: !!timestamp abc", "a: !!bool abc", "a: " + "9" * 5000,
        "a: " + "[" * 3000, "a: [1", "a: !!python/object/apply:os.getcwd []", "a: 1\nb: 2\na: 3", "x: {a: 1, a: 2}",
    ],
    ids=["a 13th month", "int", "float", "time", "bool", "5000 digits", "nested", "open", "object", "twice", "inside"],
)  # fmt: skip
def test_what_no_yaml_is_is_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"settings\.yaml: is no YAML") as caught:
        read_yaml(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["- 1", "7", "text"])
def test_a_file_of_settings_holds_a_mapping(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match="needs a mapping of settings"):
        read_yaml(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("# nothing yet\n")
    assert read_yaml(tmp_path / "a.yaml") == {}
    (tmp_path / "a.yaml").write_text("base: &base {a: 1}\nmine: {<<: *base, b: 2}\n")
    assert read_yaml(tmp_path / "a.yaml")["mine"] == {"a": 1, "b": 2}


def test_changes_are_laid_over_nested_values() -> None:
    assert laid_over({"a": {"b": 1, "c": 2}, "d": [1]}, {"a": {"c": 3}, "d": [2]}) == {"a": {"b": 1, "c": 3}, "d": [2]}
