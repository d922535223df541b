"""Citations of the paper against the table of docs/paper.md, which gives its sections and equations.

A citation has one form: "paper Sec. 4.2" or "paper Eq. 6", one number each.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CITED = re.compile(
    r"\b(?:Sec|Eq)(?:tions?|uations?|s)?\b\.?\s*\(?\d+(?:\.\d+)*|(?:paper's|publication's|its)\s+(?:section|Sec\.)\s+\"",
    re.I,
)
CANONICAL = re.compile(r"paper (Sec|Eq)\. (\d+(?:\.\d+)?)")
MORE_NUMBERS = re.compile(r"(?:,| and| or| to|-)\s*\d+(?:\.\d+)?(?=[):;,.]|\s+and\b|$)")

# What a citation of an equation speaks of, within NEARBY characters: a number that exists may still be the wrong one.
NEARBY = 160
SUBJECTS = {
    "Eq. 1": "composit|blend|transmittance",
    "Eq. 2": r"features|concatenat|H\(x\)",
    "Eq. 3": "kernel|gaussian|gamma|hit of a ray",
    "Eq. 4": "down-weight|delta|fade|focal",
    "Eq. 5": r"field|filter|G\(",
    "Eq. 6": r"plain|\bN\b|buffer|weight",
    "Eq. 7": "compos|add|sum|image|colou?r",
    "Eq. 8": "image|SSIM",
    "Eq. 9": "texture",
    "Eq. 10": "alpha",
    "Eq. 11": "opacit",
    "Eq. 12": "grid",
    "Eq. 13": "loss",
}
SECTIONS = "1 2 2.1 2.2 3 4 4.1 4.2 4.3 5 5.1 5.2 5.3 5.4 6 7 8 8.1 8.2 9 10 10.1 10.2 11 11.1 11.2 11.3".split()
KNOWN = {*SUBJECTS, *(f"Sec. {number}" for number in SECTIONS)}


def sources() -> Iterator[tuple[str, str]]:
    """Name and text of everything that may cite; a notebook's cells one by one."""
    folders = ("nexwarp", "benchmarks", "examples", "docs", "tests/reference")
    files = [file for folder in folders for end in ("py", "md") for file in ROOT.glob(f"{folder}/**/*.{end}")]
    for file in sorted([*files, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]):
        yield file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")
    for file in sorted(ROOT.glob("notebooks/*.ipynb")):
        for number, cell in enumerate(json.loads(file.read_text(encoding="utf-8"))["cells"]):
            yield f"{file.name} cell {number}", "".join(cell["source"])


def problems(name: str, text: str) -> Iterator[str]:
    """What is wrong with each citation in a text; empty where nothing is."""
    for match in CITED.finditer(text):
        start, end = match.span()
        where = f"{name}:{1 + text.count(chr(10), 0, start)}: {match.group()!r}"
        whole = CANONICAL.fullmatch(text, start - len("paper "), end)
        around = " ".join(text[max(start - NEARBY, 0) : end + NEARBY].split())
        key = f"{whole[1]}. {whole[2]}" if whole else ""
        if not whole or MORE_NUMBERS.match(text, end):
            yield f"{where}: expected one number a citation, as in 'paper Sec. 4.2'"
        elif key not in KNOWN:
            yield f"{where} is not in the table of docs/paper.md"
        elif not re.search(SUBJECTS.get(key, ""), around, re.I):
            yield f"{where}: the text around it is about something else"
        else:
            yield ""


def test_the_table_has_what_the_paper_numbers():
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert {f"{kind}. {n}" for kind, n in re.findall(r"^\| paper (Sec|Eq)\. ([\d.]+) \| .+ \|$", page, re.M)} == KNOWN


def test_citations_are_in_the_table():
    found = [problem for source in sources() for problem in problems(*source)]
    assert len(found) > 20 and not any(found), "\n".join(filter(None, found))


def test_equations_of_the_method_page_have_their_numbers():
    tags = re.findall(r"\\tag\{(\d+)\}", (ROOT / "docs" / "method.md").read_text(encoding="utf-8"))
    assert tags == [str(n) for n in range(1, 14)]
