"""The command line's own errors: one line on standard error that names the option, and exit code 2."""

import sys
from typing import get_args, get_type_hints

import pytest
import typer

from pipelines.cli import app, main
from pipelines.cli_errors import USAGE_ERRORS, parser_error
from pipelines.cli_training import generate
from training.config import Convention


def words_of(value):
    return " ".join(value) if isinstance(value, list) else ""


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Exit code, standard output and standard error of a command, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["animatic", *words])
        with pytest.raises(SystemExit) as end:
            main()
        out = capsys.readouterr()
        return end.value.code, out.out, out.err

    return call


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["label", "--nope"], "no such option: --nope; `"),
        (["label"], "missing option '--out' / '-o'; "),
        (["plan"], "missing argument"),
        (["label", "v.mp4", "-o", "J", "--workers", "two"], "'--workers'"),
        (["label", "v.mp4", "-o", "J", "--workers", "-1"], "'--workers'"),
        (["generate", "-o", "x", "--coordinates", "polar"], "'--coordinates'"),
        (["inspect", "a", "b", "c"], "inspect --help` says what there is"),
        (["labl"], "no such command 'labl'. Did you mean 'label'? `"),
        (["models", "--nope"], "models --help` says"),
    ],
    ids=["option", "no option", "no argument", "type", "bound", "choice", "too many", "command", "group"],
)
def test_what_the_parser_refuses_is_one_line(run, words, message):
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and message in err and err.count("\n") == 1


@pytest.mark.parametrize("words", [["--help"], ["label", "--help"], ["models", "--help"]], ids=words_of)
def test_help_is_as_typer_gives_it(run, capsys, words):
    ours = run(*words)
    with pytest.raises(SystemExit):
        app(words)
    assert ours == (0, capsys.readouterr().out, "") and "Usage: " in ours[1]


def test_no_word_at_all_shows_the_help(run):
    code, out, err = run()
    assert code == 2 and "Usage: " in out + err and "error" not in err


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["label", "v.mp4", "--out", ""], "--out"),
        (["label", "v.mp4", "--out="], "--out"),
        (["index", "v.mp4", "-o", ""], "-o"),
        (["select", "--out", ""], "--out"),
        (["cut", "--out", ""], "--out"),
        (["export", "coco", "J", "--out", ""], "--out"),
        (["label", "v.mp4", "-o", "J", "--config", ""], "--config"),
        (["ego", "J", "--import", ""], "--import"),
        (["models", "--models", ""], "--models"),
        (["generate", "--out", ""], "--out"),
        (["study", "--out", ""], "--out"),
        (["label", "", "-o", "J"], "an argument"),
        (["status", ""], "an argument"),
        (["status", "--json", ""], "an argument"),
    ],
    ids=words_of,
)
def test_an_empty_path_names_no_folder(run, tmp_path, words, name):
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {name} is empty; give a path") and err.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_text_may_be_empty(run):
    _, _, err = run("cache", "J", "--backbone", "tiny", "--controls", "")
    assert "is empty" not in err


def test_the_parsers_errors_are_those_of_this_typer():
    assert USAGE_ERRORS in typer.BadParameter.__mro__ and USAGE_ERRORS.__name__ == "ClickException"
    assert USAGE_ERRORS("words").format_message() == "words"  # type: ignore[attr-defined]
    assert not issubclass(typer.Exit, USAGE_ERRORS) and not issubclass(typer.Abort, USAGE_ERRORS)


@pytest.mark.parametrize(
    "known", [KeyError, type("ClickException", (Exception,), {})], ids=["no such name", "by its name alone"]
)
def test_a_typer_that_keeps_no_such_error_is_said(known):
    with pytest.raises(ImportError, match=f"this typer's {known.__name__} is no ClickException .* constraints.txt"):
        parser_error(known)


def test_choices_of_generate_are_those_of_the_sampler():
    """The command line spells them out, since it loads no settings before a command is called."""
    coordinates = get_type_hints(generate)["coordinates"]
    assert get_args(coordinates) == get_args(Convention)


@pytest.mark.parametrize(("words", "clips"), [(["--clips", ""], ""), (["--true-skeletons"], "val")])
def test_clips_of_no_name_are_not_those_of_no_option(words, clips, run, monkeypatch):
    asked = []
    monkeypatch.setattr("pipelines.generate_clips.show_clips", lambda job, request, **given: asked.append(request))
    code, _, _ = run("generate", "--data", "job", "--out", "out", "--appearance", "adapter", *words)
    assert code == 0 and [request.clips for request in asked] == [clips]
