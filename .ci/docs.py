"""Faults of the documentation: prints each, and fails where there is one. `python .ci/docs.py docs/_build/html`.

Sentences of more than 25 words in README, pages and notebooks; colours of the report's text with a contrast below 4.5
(WCAG 2.2, AA); in the built site images without alternative text, and links to pages or anchors that are not there.
"""

import html
import json
import re
import sys
from pathlib import Path

MAX_WORDS = 25
LEAST_CONTRAST = 4.5
ALT = re.compile(r'alt="(?!\.\./)[^"]+"')  # not the path, which stands where there are no words
ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^(```|\$\$|<!--).*?(^```|\$\$|-->)$", re.M | re.S)
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/notebooks").glob("*.ipynb")))


def text_of(page: Path) -> str:
    """The Markdown of a page or of a notebook's cells."""
    if page.suffix == ".md":
        return page.read_text()
    cells = json.loads(page.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def sentences(text: str) -> list[str]:
    """Sentences of paragraphs and list items; code counts as one word, tables and headings do not count."""
    text = FENCE.sub("", text)
    text = re.sub(r"^(\||#| {4}).*$", "", text, flags=re.M)  # tables, headings, indented code
    text = re.sub(r"`[^`]+`|\$[^$]+\$", "x", text).replace("*", "")
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    blocks = re.split(r"\n\s*\n|\n(?=\s*[-*\d]+\.? )", text)
    return [one for block in blocks for one in re.split(r"(?<=[.!?])\s+", " ".join(block.lstrip(" -").split()))]


def luminance(colour: str) -> float:
    """Relative luminance of a colour such as #0b6b50 (WCAG 2.2)."""
    channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def faults_of_colours(style: Path) -> list[str]:
    """Texts of the report that are hard to read, light and dark."""
    faults, colours = [], {}
    for block in re.findall(r":root \{(.*?)\}", style.read_text(), re.S):
        colours |= dict(re.findall(r"--([a-z]+): (#[0-9a-f]{6})", block))
        for text in ("ink", "soft", "good", "bad", "open"):
            for ground in ("paper", "panel"):
                dark, light = sorted(luminance(colours[name]) for name in (text, ground))
                contrast = (light + 0.05) / (dark + 0.05)
                faults += [f"{style}: contrast {contrast:.2f} of {text} on {ground}"] * (contrast < LEAST_CONTRAST)
    return faults


def faults_of_site(site: Path) -> list[str]:
    """Images without words, and dead links, of a built site."""
    pages = {page: page.read_text() for page in site.rglob("*.html")}
    anchors = {page: set(re.findall(r'\bid="([^"]+)"', text)) for page, text in pages.items()}
    faults = []
    for page, text in pages.items():
        faults += [f"{page}: {image}" for image in re.findall(r"<img[^>]*>", text) if not ALT.search(image)]
        for link in re.findall(r'<a[^>]* href="(?!\w+:)([^"]+)"', text):
            path, _, anchor = html.unescape(link).partition("#")
            target = (page.parent / path.split("?")[0]).resolve() if path else page
            if not target.exists() or (anchor and anchor not in anchors.get(target, {anchor})):
                faults.append(f"{page}: dead link {link}")
    return faults


def main() -> int:
    """Print what is wrong."""
    long = [(page, one) for page in PAGES for one in sentences(text_of(page)) if len(one.split()) > MAX_WORDS]
    faults = [f"{page.relative_to(ROOT)}: {len(one.split())} words: {one}" for page, one in long]
    faults += faults_of_colours(ROOT / "fg_calib/report/style.css")
    for site in sys.argv[1:]:
        faults += faults_of_site(Path(site).resolve())
    print(*faults, sep="\n", end="\n" if faults else "")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
