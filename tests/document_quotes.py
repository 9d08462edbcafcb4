"""Whether a document says what was measured: its own words are given, with each measured figure in [brackets].

A figure agrees if it is the measured one, rounded to the digits that the document prints. Words that do not occur
disagree too, so that a sentence which is reworded does not lose its check unseen.
"""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import ROUND_HALF_DOWN, ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "tests" / "benchmarks" / "results"
IN_WORDS = ("none", "one", "two", "three", "four", "five", "six")

PRINTED_NUMBER = r"([+-]?\d+(?:,\d{3})*(?:\.\d+)?(?:e-\d+)?)"
PRINTED_PHRASE = r"([^|()]+?)"


@dataclass(frozen=True, slots=True)
class Quote:
    document: str
    """Its path from the project's root."""
    words: str
    """``[3.4375] times: [held]`` where the document says ``3.4 times: held``; a space may be a line's end there."""

    def disagreements(self, text: str) -> Iterator[str]:
        """A line for each figure in the document's ``text`` that is not the measured one."""
        *parts, rest = re.split(r"\[(.*?)\]", self.words)
        literals, figures = parts[::2], parts[1::2]
        pattern = "".join(spaced(literal) + hole(figure) for literal, figure in zip(literals, figures, strict=True))
        places = list(re.finditer(pattern + spaced(rest), text))
        if not places:
            yield f"{self.document} does not say: {self.words}"
        for place in places:
            sentence = " ".join(place[0].split())
            for group, figure in enumerate(figures, start=1):
                if measured := correction(place[group], figure):
                    line = text.count("\n", 0, place.start(group)) + 1
                    yield f"{self.document}:{line} says {place[group]} where {measured} was measured: {sentence}"


def spaced(literal: str) -> str:
    return r"\s+".join(map(re.escape, literal.split(" ")))


def hole(figure: str) -> str:
    return PRINTED_NUMBER if is_number(figure) else PRINTED_PHRASE


def is_number(figure: str) -> bool:
    return re.fullmatch(r"-?[\d.]+(e[+-]?\d+)?", figure) is not None


def correction(printed: str, figure: str) -> str | None:
    """What should stand in place of ``printed``; None where it agrees. Half way between two numbers, either does."""
    if not is_number(figure):
        return None if " ".join(printed.split()).strip("*") == figure else figure
    said, measured = Decimal(printed.replace(",", "")), Decimal(f"{float(figure):.9g}")
    up, down = (measured.quantize(said, rounding=way) for way in (ROUND_HALF_UP, ROUND_HALF_DOWN))
    return None if said in (up, down) else f"{up:f}"


Quotes = Callable[[Any], Iterator[Quote]]
"""From what a file of results holds: what the documents say of it."""


def results(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def readme(words: str) -> Quote:
    return Quote("README.md", words)


def measurements(words: str) -> Quote:
    return Quote("docs/measurements.md", words)


def street_models(words: str) -> Quote:
    return Quote("docs/street_models.md", words)


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", text)]


def verdict(holds: bool) -> str:
    return "held" if holds else "missed"


def ms(measured: Any) -> float:
    return measured["ms_per_frame"]["median"]
