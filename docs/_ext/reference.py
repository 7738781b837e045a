"""The reference, written from the package itself: its commands and its public names with their docstrings."""

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from docutils import nodes
from paper import paper
from pygments.lexers.special import TextLexer
from sphinx import addnodes
from sphinx.pycode import ModuleAnalyzer

import fg_calib
from fg_calib.cli.entry import build_app

HERE = Path(__file__).resolve().parents[1] / "generated"
STUBS = sorted(Path(fg_calib.__file__).parent.rglob("__init__.pyi"))
DESCRIBED: dict[str, str] = {}
"""By where a class or function is defined, the public name that the reference has for it."""


def title(text: str, line: str = "=") -> str:
    """A heading."""
    return f"{text}\n{line * len(text)}\n\n"


def indented(text: str) -> str:
    """Text within a directive."""
    return "".join(f"   {line}\n" for line in text.splitlines()) + "\n"


def commands() -> str:
    """The page of the command line, from the help of each command."""
    page = title("Command line") + "``fg-calib COMMAND --help`` prints the same.\n\n"
    for name, command in typer.main.get_command(build_app()).commands.items():
        context = command.make_context(f"fg-calib {name}", [], resilient_parsing=True)
        page += title(name, "-") + (command.help or "") + "\n\n"
        page += "::\n\n" + indented(command.get_usage(context).removeprefix("Usage: "))
        page += f".. program:: fg-calib {name}\n\n"
        for parameter in command.params:
            names, text = parameter.get_help_record(context)
            page += f".. option:: {names}\n\n" + indented(text)
    return page


def api(stub: Path) -> tuple[str, str]:
    """A package and its page: the names in its stub, those that another page has as links."""
    package = ".".join(("fg_calib", *stub.relative_to(STUBS[0].parent).parts[:-1]))
    module = import_module(package)
    page = title(package) + f".. py:module:: {package}\n\n{inspect.getdoc(module)}\n\n"
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    names = {alias.name: f"{package}.{node.module}" for node in imports for alias in node.names}
    for name in sorted(names, key=str.lower):
        thing, full = getattr(module, name), f"{package}.{name}"
        if inspect.isclass(thing) or inspect.isfunction(thing):
            described = DESCRIBED.setdefault(f"{thing.__module__}.{thing.__qualname__}", full)
            if described != full:
                page += f"* ``{name}`` is :py:obj:`{described}`.\n\n"
            else:
                page += f".. auto{'class' if inspect.isclass(thing) else 'function'}:: {full}\n\n"
        elif text := ModuleAnalyzer.for_module(names[name]).find_attr_docs().get(("", name)):
            page += f".. py:data:: {full}\n\n" + indented("\n".join(text))
    return package, page


def write(*_: Any) -> None:
    """Write the pages that changed."""
    HERE.mkdir(exist_ok=True)
    for name, text in (("cli", commands()), ("paper", paper()), *map(api, STUBS)):
        file = HERE / f"{name}.rst"
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def link(_: Any, doctree: nodes.document) -> None:
    """Link the types that the reference describes; shapes, and types of other packages, are words."""
    short = {at.rpartition(".")[2]: at for at in DESCRIBED.values()}
    for node in list(doctree.findall(addnodes.pending_xref)):
        target = node.get("reftarget", "")
        if node.get("refdomain") == "py" and target not in DESCRIBED.values():
            if at := DESCRIBED.get(target, short.get(target)):
                node["reftarget"] = at
            else:
                node.replace_self(node.children)


def escape(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Let bars in docstrings be those of norms."""
    lines[:] = [re.sub(r"(`[^`]*`)|\|", lambda found: found[1] or r"\|", line) for line in lines]


def setup(app: Any) -> dict[str, bool]:
    """Write before pages are looked for."""
    app.connect("config-inited", write)
    app.connect("autodoc-process-docstring", escape, priority=400)
    app.connect("doctree-read", link)
    app.add_lexer("csv", TextLexer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
