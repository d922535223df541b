"""Hook of mkdocs: documents outside docs/ and the live demo become pages, and links work as they do on GitHub.

A page of the site stands where its file stands in the repository, except that docs/ is the root. A link to a source
file, which the site does not have, becomes its plain text.
"""

import logging
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "benchmarks/LOG.md")
# The live demo: its scene is in docs/demo_page/, the page itself in the package.
DEMO_FOLDER, DEMO_TITLE = "demo_page", "nexwarp demo"
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)")
log = logging.getLogger("mkdocs.plugins.pages")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the documents outside docs/, and the page of the live demo."""
    for pattern in PAGES:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, content=path.read_text(encoding="utf-8")))
    for path in sorted([*ROOT.glob("nexwarp/export/web/page/*"), *ROOT.glob("nexwarp/export/web/shaders/*.wgsl")]):
        folder = DEMO_FOLDER if path.parent.name == "page" else f"{DEMO_FOLDER}/shaders"
        text = path.read_text(encoding="utf-8").replace("__TITLE__", DEMO_TITLE)
        files.append(File.generated(config, f"{folder}/{path.name}", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files, **_: Any) -> str:
    """Turn links between files of the repository into links between pages."""
    here = page.file.src_uri
    in_docs = (ROOT / "docs" / here).is_file()
    folder = posixpath.dirname(f"docs/{here}" if in_docs else here)

    def replaced(match: re.Match[str]) -> str:
        picture, text, target, anchor = match.groups()
        path = posixpath.normpath(posixpath.join(folder, target))
        if not (ROOT / path).exists():
            log.warning("%s: no such file in the repository: %s", here, target)
            return match[0]
        name = "index.md" if path == "README.md" else path.removeprefix("docs/")
        if files.get_file_from_path(name) is None:
            return text
        anchor = "" if path == "README.md" else anchor or ""
        return f"{picture}[{text}]({posixpath.relpath(name, posixpath.dirname(here) or '.')}{anchor})"

    parts = re.split(r"(^```.*?^```)", markdown, flags=re.M | re.S)  # odd ones are programs
    return "".join(part if i % 2 else LINK.sub(replaced, part) for i, part in enumerate(parts))
