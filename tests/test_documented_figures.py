"""The figures that people read are those that were measured: README.md and docs/ against ``benchmarks/results``.

A command writes the results and a person the sentences about them: what is measured again leaves sentences behind that
are no longer true. ``quotes_of_charts.py`` and ``quotes_of_benchmarks.py`` hold, for each file of results, what the
documents say of it, and no figure. What was tried once, or before on another machine, has no results and no place
there.
"""

import pytest
from document_quotes import RESULTS, ROOT, Quote, results
from quotes_of_benchmarks import BENCHMARKS
from quotes_of_charts import CHARTS

QUOTES_OF = {**CHARTS, **BENCHMARKS}


@pytest.mark.parametrize("name", QUOTES_OF)
def test_documents_say_what_was_measured(name: str) -> None:
    wrong = []
    for quote in QUOTES_OF[name](results(name)):
        wrong += quote.disagreements((ROOT / quote.document).read_text(encoding="utf-8"))
    assert not wrong, f"against {name}.json:\n" + "\n".join(wrong)


def test_all_results_are_quoted() -> None:
    assert set(QUOTES_OF) == {path.stem for path in RESULTS.glob("*.json")}


TEXT = "# Title\n\nIt is 3.4 times cheaper (1,234 of\n4,200 ms; aim 3: held), within 3e-5 px.\n"


@pytest.mark.parametrize(
    "words",
    [
        "[3.4375] times cheaper ([1233.6] of [4200] ms; aim [3.0]: [held])",
        "is [3.35] times",
        "is [3.45] times",
        "within [3.0517578125e-05] px",
    ],
)
def test_measured_figures_agree_to_the_digits_that_are_printed(words: str) -> None:
    assert not list(Quote("a.md", words).disagreements(TEXT))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("is [3.46] times", "a.md:3 says 3.4 where 3.5 was measured: is 3.4 times"),
        ("of [4300] ms", "a.md:4 says 4,200 where 4300 was measured: of 4,200 ms"),
        ("aim [3]: [missed])", "a.md:4 says held where missed was measured: aim 3: held)"),
        ("within [0.00004] px", "a.md:4 says 3e-5 where 0.00004 was measured: within 3e-5 px"),
        ("[3.4375] times dearer", "a.md does not say: [3.4375] times dearer"),
    ],
)
def test_what_disagrees_is_named_with_its_line(words: str, line: str) -> None:
    assert list(Quote("a.md", words).disagreements(TEXT)) == [line]
