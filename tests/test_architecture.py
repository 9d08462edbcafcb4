"""The house rules that a machine can check: import ranks, no torch in labelling, nothing loaded that could run code.

That ``--help`` loads nothing heavy is checked where commands are, in ``test_cli.py``.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
RANK = {"labeling": 0, "dataset": 1, "training": 2, "pipelines": 3}
MODULES = sorted(path for package in RANK for path in (ROOT / package).rglob("*.py"))


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def named(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def source_of(node: ast.ImportFrom, module: str) -> str:
    """The absolute name of what a ``from`` statement in ``module`` imports from."""
    above = module.split(".")[: -node.level] if node.level else []
    return ".".join([*above, *([node.module] if node.module else [])])


def imported_modules(tree: ast.Module, module: str) -> set[str]:
    """Every module that the file of ``module`` imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []  # names for the type checker alone are never imported
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = source_of(node, module)
            names |= {source, *(f"{source}.{alias.name}".lstrip(".") for alias in node.names)}
    return names


def imports_against_the_rank(tree: ast.Module, module: str) -> list[str]:
    """The packages of a higher rank that ``module`` imports, and torch where it may not."""
    rank = RANK[module.split(".")[0]]
    roots = {name.split(".")[0] for name in imported_modules(tree, module)}
    return sorted(root for root in roots if RANK.get(root, -1) > rank or (root == "torch" and rank == 0))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_rank(path: Path) -> None:
    against = imports_against_the_rank(parsed(path), named(path))
    assert not against, f"{path.name} imports {against} against the rank; labelling must run without torch"


@pytest.mark.parametrize(
    ("text", "against"),
    [
        ("from training import flow", ["training"]),
        ("def f():\n    import pipelines.cli", ["pipelines"]),
        ("from torch import nn", ["torch"]),
        ("from .. import training", ["training"]),
        ("from ..training.flow import x", ["training"]),
        ("from . import camera", []),
        ("from .camera import training", []),
        ("if TYPE_CHECKING:\n    import torch", []),
    ],
    ids=lambda value: value.replace("\n", " ") if isinstance(value, str) else "",
)
def test_imports_against_the_rank_are_seen(text: str, against: list[str]) -> None:
    assert imports_against_the_rank(ast.parse(text), "labeling.video") == against


def test_no_import_circles_inside_a_rank() -> None:
    known = {named(path): path for path in MODULES}
    graph = {name: imported_modules(parsed(path), name) & set(known) - {name} for name, path in known.items()}
    state: dict[str, str] = {}

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert state.get(name) != "open", f"import circle: {' -> '.join((*trail, name))}"
        if state.get(name) == "done":
            return
        state[name] = "open"
        for other in sorted(graph[name]):
            visit(other, (*trail, name))
        state[name] = "done"

    for name in graph:
        visit(name, ())


def called(node: ast.Call, aliases: dict[str, str]) -> str:
    """The full name of what is called, whatever it was imported as."""
    head, dot, rest = ast.unparse(node.func).partition(".")
    return aliases.get(head, head) + dot + rest


def dangerous_calls(tree: ast.Module) -> list[str]:
    """Calls that run code from data or from a string, each with its line."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            aliases |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = called(node, aliases)
        keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        if (
            name in {"eval", "exec", "os.system", "os.popen"}
            or name.split(".")[0] in {"pickle", "_pickle", "dill", "cloudpickle"}
            or keywords.get("shell", "False") != "False"
            or keywords.get("allow_pickle", "False") != "False"
            or (name == "torch.load" and keywords.get("weights_only") != "True")
        ):
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
    return found


def test_no_dangerous_loading() -> None:
    assert [f"{path}: {call}" for path in MODULES for call in dangerous_calls(parsed(path))] == []


@pytest.mark.parametrize(
    ("text", "dangerous"),
    [
        ("eval('1')", True),
        ("import pickle\npickle.load(f)", True),
        ("import pickle as p\np.loads(b)", True),
        ("from pickle import load\nload(f)", True),
        ("from pickle import Unpickler as U\nU(f).load()", True),
        ("from os import system\nsystem('ls')", True),
        ("import numpy as np\nnp.load(f, allow_pickle=True)", True),
        ("import torch\ntorch.load(f)", True),
        ("from torch import load as read\nread(f, weights_only=False)", True),
        ("import subprocess\nsubprocess.run('ls', shell=True)", True),
        ("import numpy as np\nnp.load(f, allow_pickle=False)", False),
        ("import torch\ntorch.load(f, weights_only=True)", False),
        ("import json\njson.load(f)", False),
        ("from json import load\nload(f)", False),
        ("model.eval()", False),
    ],
    ids=lambda value: value.replace("\n", " ") if isinstance(value, str) else "refused" if value else "allowed",
)
def test_dangerous_loading_is_seen_and_harmless_allowed(text: str, dangerous: bool) -> None:
    assert bool(dangerous_calls(ast.parse(text))) is dangerous
