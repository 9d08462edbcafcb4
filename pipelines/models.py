"""``animatic models``: the cards, which weights are present, and how to get the others."""

import json
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from labeling.errors import ConfigError
from labeling.model_cards import find_weights, load_cards, weights_folders, weights_state, weights_without_card
from pipelines.console import make_console


def print_models(models_dir: Path | None, *, as_json: bool = False) -> int:
    """List every card with the state of its weights; 1 where a file is not what its card means.

    Raises:
        ConfigError: ``models_dir`` is no folder.
        ModelError: a card that breaks the rules.
    """
    check_models_folder(models_dir)
    cards = load_cards(models_dir)
    states = {name: weights_state(card, models_dir) for name, card in cards.items()}
    folders = weights_folders(models_dir)
    strays = [path for folder in folders if folder.is_dir() for path in weights_without_card(folder, cards)]
    wrong = any(state == "wrong hash" for state in states.values())
    if as_json:
        values = {
            name: {**card.model_dump(mode="json", by_alias=True), "state": states[name],
                   "path": str(path) if (path := find_weights(card, models_dir)) else None}
            for name, card in cards.items()
        }  # fmt: skip
        print(json.dumps({"cards": values, "folders": [str(f) for f in folders]}, indent=1))
        return int(wrong)
    console = make_console()
    table = Table(box=None, pad_edge=False)
    for column in ("card", "kind", "gives", "weights", "licence"):
        table.add_column(column, style="bold" if column == "card" else "")
    colours = {"present": "green", "absent": "dim", "wrong hash": "red"}
    for name, card in cards.items():
        state = states[name]
        table.add_row(name, card.kind, _gives(card), f"[{colours[state]}]{state}[/]", escape(card.licence))
    console.print(table)
    console.print(f"weights are looked for in {', then '.join(_place(folder) for folder in folders)}")
    for name, card in cards.items():
        if states[name] != "present":
            console.print(f"[bold]{name}[/]: put {card.file} there; {escape(card.source)}")
    for path in strays:
        console.print(f"[yellow]{path}[/]: no card names this file, so it is never used; write a card beside it")
    return int(wrong)


def check_models_folder(models_dir: Path | None) -> None:
    """Raise ``ConfigError`` where a person named a folder of weights that is none."""
    if models_dir is not None and not models_dir.is_dir():
        raise ConfigError(f"--models {models_dir}: is no folder; give the folder that holds the ONNX files")


def _place(folder: Path) -> str:
    """A folder of weights, and whether it holds any."""
    if not folder.is_dir():
        return f"{escape(str(folder))} [yellow](there is no such folder)[/]"
    empty = next(folder.glob("*.onnx"), None) is None
    return escape(str(folder)) + " [yellow](holds no .onnx file)[/]" * empty


def _gives(card: object) -> str:
    """What a card's network gives, in a word or two."""
    classes = getattr(card, "class_names", None)
    if classes is not None:
        return f"boxes of {len(classes)} classes"
    heads = getattr(card, "heads", None)
    if heads is not None:
        return ", ".join(head.schema_name for head in heads)
    return str(getattr(card, "schema_name", ""))
