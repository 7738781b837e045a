"""Pages read on GitHub and here: links to files outside `docs/` lead to the pages that include them."""

import os
import re
from pathlib import Path
from typing import Any

from docutils import nodes

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
INCLUDE = re.compile(r"^```\{include\} (\S+)\n```$", re.M)
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]*)(#[^)\s]*)?\)")
FENCED = re.compile(r"(^```.*?^```$)", re.M | re.S)

PAGES = {
    (page.parent / found[1]).resolve(): page
    for page in DOCS.glob("*.md")
    if (found := INCLUDE.search(page.read_text()))
}
"""Pages of files outside `docs/`."""


def with_links(text: str, file: Path, page: Path) -> str:
    """The text of a file as a page has it: links lead to pages, those to other files of the repository are words."""

    def link(found: re.Match[str]) -> str:
        image, words, path, anchor = found.groups(default="")
        target = (file.parent / path).resolve() if path else file
        target = PAGES.get(target, target)
        if not image and DOCS not in target.parents and target.exists():
            return f"`{target.relative_to(ROOT)}`" if words.strip("`") in path else words
        return f"{image}[{words}]({os.path.relpath(target, page.parent)}{anchor})"

    parts = FENCED.split(text)
    return "".join(part if part.startswith("```") else LINK.sub(link, part) for part in parts)


def read(app: Any, docname: str, source: list[str]) -> None:
    """Take included files in, and lead links to pages."""
    page = Path(app.env.doc2path(docname))
    if page.suffix != ".md":
        return

    def include(found: re.Match[str]) -> str:
        file = (page.parent / found[1]).resolve()
        app.env.note_dependency(str(file))
        return with_links(file.read_text(), file, page)

    source[0] = INCLUDE.sub(include, with_links(source[0], page, page))


def describe(app: Any, doctree: nodes.document, docname: str) -> None:
    """Give figures that notebooks draw the words of their section as alternative text."""
    for image in doctree.findall(nodes.image):
        section = image.parent
        while section is not None and not isinstance(section, nodes.section):
            section = section.parent
        if not image.get("alt") and section is not None:
            image["alt"] = f"Figure: {section.next_node(nodes.title).astext()}"


def setup(app: Any) -> dict[str, bool]:
    """Connect the reader of pages."""
    app.connect("source-read", read)
    app.connect("doctree-resolved", describe)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
