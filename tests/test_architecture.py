"""The house rules that a machine can check: import ranks, no torch in labelling, nothing heavy on ``--help``."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
RANK = {"labeling": 0, "dataset": 1, "training": 2, "pipelines": 3}
MODULES = sorted(path for package in RANK for path in (ROOT / package).rglob("*.py"))


def imported_modules(path: Path) -> set[str]:
    """Every module that a file imports, anywhere in it."""
    names: set[str] = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []  # names for the type checker alone are never imported
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_rank(path: Path) -> None:
    rank = RANK[path.relative_to(ROOT).parts[0]]
    roots = {name.split(".")[0] for name in imported_modules(path)}
    against = [root for root in roots if RANK.get(root, -1) > rank]
    assert not against, f"{path.name} imports {against} against the rank"
    if rank == 0:
        assert "torch" not in roots, f"{path.name} imports torch; labelling must run without it"


def test_no_import_circles_inside_a_rank() -> None:
    def dotted(path: Path) -> str:
        return ".".join(path.relative_to(ROOT).with_suffix("").parts)

    known = {dotted(path): path for path in MODULES}
    graph = {name: imported_modules(path) & set(known) - {name} for name, path in known.items()}
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


def test_no_dangerous_loading() -> None:
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call):
                continue
            name = ast.unparse(node.func)
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            assert name not in {"eval", "exec", "pickle.load", "pickle.loads", "os.system"}, f"{path}:{node.lineno}"
            assert keywords.get("shell") != "True", f"{path}:{node.lineno} runs a shell string"
            if name == "torch.load":
                assert keywords.get("weights_only") == "True", f"{path}:{node.lineno} loads without weights_only=True"
