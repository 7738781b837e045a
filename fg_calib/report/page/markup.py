"""Elements of HTML and SVG: text is text, whatever it holds, and nothing that is not printable gets through."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from fg_calib.errors import escaped

if TYPE_CHECKING:  # lxml is imported where it is used
    from lxml.etree import _Element as Element

Content = Any  # an `Element`, text, None, or a list of these


def tag(name: str, *content: Content, **attributes: str | float | None) -> Element:
    """An element.

    Args:
        name: Of the element.
        content: Elements and text; None is nothing, lists are gone through.
        attributes: By name, a trailing _ removed and others as -; None is left out.
    """
    from lxml import etree

    plain = {
        key.rstrip("_").replace("_", "-"): escaped(value) if isinstance(value, str) else figure(value)
        for key, value in attributes.items()
        if value is not None
    }
    element = etree.Element(name, plain)
    add(element, *content)
    return element


def add(element: Element, *content: Content) -> None:
    """Put elements and text at the end of an element."""
    for one in content:
        if one is None:
            continue
        if isinstance(one, list | tuple):
            add(element, *one)
        elif not isinstance(one, str):
            element.append(one)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + escaped(one)
        else:
            element.text = (element.text or "") + escaped(one)


def figure(value: float) -> str:
    """A coordinate in few characters."""
    return f"{value:.1f}".removesuffix(".0") if abs(value) < 1e6 else f"{value:g}"


def data(name: str, document: Any) -> Element:
    """Data for a script of the page: in it there is no `<`, so that nothing ends it early."""
    from lxml import etree

    element = etree.Element("script", {"type": "application/json", "id": name})
    text = json.dumps(_printable(document), allow_nan=False, separators=(",", ":"))
    element.text = text.replace("<", "\\u003c").replace("&", "\\u0026")
    return element


def _printable(document: Any) -> Any:
    """A document whose texts steer nothing."""
    if isinstance(document, dict):
        return {key: _printable(value) for key, value in document.items()}
    if isinstance(document, list):
        return [_printable(value) for value in document]
    return escaped(document) if isinstance(document, str) else document


def as_html(root: Element) -> str:
    """A page as text."""
    from lxml import etree

    text: str = etree.tostring(root, method="html", encoding="unicode", doctype="<!DOCTYPE html>")
    return text + "\n"
