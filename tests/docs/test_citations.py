"""Citations of the paper against the table of docs/paper.md, which gives its sections and equations.

A citation has one form: "paper Sec. 4.2" or "paper Eq. 6", one number each.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs" / "paper.md"
CITED = re.compile(r"\b(Sec|Eq)(?:tions?|uations?|s)?\b\.?\s*\(?(\d+(?:\.\d+)*)", re.I)
CANONICAL = re.compile(r"paper (Sec|Eq)\. (\d+(?:\.\d+)?)")
MORE_NUMBERS = re.compile(r"(?:,| and| or| to|-)\s*\d+(?:\.\d+)?(?=[):;,.]|\s+and\b|$)")
BY_TITLE = re.compile(r"(?:paper's|publication's|its)\s+(?:section|Sec\.)\s+\"[^\"]*\"", re.I)

# What a citation of an equation speaks of, within NEARBY characters: a number that exists may still be the wrong one.
NEARBY = 160
SUBJECTS = {
    "1": "composit|blend|transmittance",
    "2": r"features|concatenat|H\(x\)",
    "3": "kernel|gaussian|gamma|hit of a ray",
    "4": "down-weight|delta|fade|focal",
    "5": r"field|filter|G\(",
    "6": r"plain|\bN\b|buffer|weight",
    "7": "compos|add|sum|image|colou?r",
    "8": "image|SSIM",
    "9": "texture",
    "10": "alpha",
    "11": "opacit",
    "12": "grid",
    "13": "loss",
}


class Citation(NamedTuple):
    """One place that cites the paper."""

    where: str
    text: str
    key: str  # as in the table, "Sec. 4.2"; empty where the form is not the canonical one
    around: str


def sources() -> Iterator[tuple[str, str]]:
    """Name and text of everything that may cite; a notebook's cells one by one."""
    folders = ("nexwarp", "benchmarks", "examples", "docs", "tests/reference")
    files = [file for folder in folders for end in ("py", "md") for file in ROOT.glob(f"{folder}/**/*.{end}")]
    for file in sorted([*files, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]):
        yield file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")
    for file in sorted(ROOT.glob("notebooks/*.ipynb")):
        for number, cell in enumerate(json.loads(file.read_text(encoding="utf-8"))["cells"]):
            yield f"{file.name} cell {number}", "".join(cell["source"])


def citations(name: str, text: str) -> Iterator[Citation]:
    """Every citation in a text, in order."""
    for match in sorted([*CITED.finditer(text), *BY_TITLE.finditer(text)], key=lambda match: match.start()):
        start, end = match.span()
        whole = CANONICAL.fullmatch(text, start - len("paper "), end)
        more = MORE_NUMBERS.match(text, end)
        key = f"{whole[1]}. {whole[2]}" if whole and not more else ""
        around = " ".join(text[max(start - NEARBY, 0) : end + NEARBY].split())
        yield Citation(f"{name}:{1 + text.count(chr(10), 0, start)}", match.group(), key, around)


def table() -> dict[str, str]:
    """Sections and equations of the table, with what it says of them."""
    rows = re.findall(r"^\| paper (Sec|Eq)\. ([\d.]+) \| (.+) \|$", TABLE.read_text(encoding="utf-8"), re.M)
    return {f"{kind}. {number}": text for kind, number, text in rows}


def problem(citation: Citation, known: dict[str, str]) -> str | None:
    """What is wrong with a citation, if anything."""
    if not citation.key:
        return f"{citation.where}: expected one number a citation, as in 'paper Sec. 4.2', got {citation.text!r}"
    if citation.key not in known:
        return f"{citation.where}: {citation.text!r} is not in the table of docs/paper.md"
    subject = SUBJECTS.get(citation.key.removeprefix("Eq. ")) if citation.key.startswith("Eq.") else None
    if subject and not re.search(subject, citation.around, re.I):
        return f"{citation.where}: {citation.text!r} is about {known[citation.key]!r}, the text around it is not"
    return None


def test_the_table_has_what_the_paper_numbers():
    sections = {"1", "2", "2.1", "2.2", "3", "4", "4.1", "4.2", "4.3", "5", "5.1", "5.2", "5.3", "5.4", "6", "7", "8"}
    sections |= {"8.1", "8.2", "9", "10", "10.1", "10.2", "11", "11.1", "11.2", "11.3"}
    equations = {str(n) for n in range(1, 14)}
    assert set(table()) == {f"Sec. {n}" for n in sections} | {f"Eq. {n}" for n in equations}
    assert set(SUBJECTS) == equations


def test_citations_are_in_the_table():
    known = table()
    found = [citation for source in sources() for citation in citations(*source)]
    assert len(found) > 20
    problems = [text for citation in found if (text := problem(citation, known)) is not None]
    assert not problems, "\n" + "\n".join(problems)


def test_equations_of_the_method_page_have_their_numbers():
    """The page numbers its equations as the paper does; each number once."""
    tags = re.findall(r"\\tag\{(\d+)\}", (ROOT / "docs" / "method.md").read_text(encoding="utf-8"))
    assert tags == [str(n) for n in range(1, 14)]


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("Densification (paper Sec. 4.3, paper Sec. 8.2).", True),
        ("Collection pass (paper Sec. 3.2).", False),
        ("Collection pass (Sec. 4.2).", False),
        ("fades levels, Delta (paper Eq. 4 and 5)", False),
        ("Adam's moments (paper Eq. 4)", False),
    ],
)
def test_what_counts_as_a_citation(text, right):
    cited = list(citations("text", text))
    assert cited and all(problem(citation, table()) is None for citation in cited) == right
