"""The reference, written from the package itself: its commands and its public names with their docstrings."""

import ast
import inspect
import re
import textwrap
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
    text = re.sub(r"\n\n(?=    )", "\n\n::\n\n", inspect.getdoc(module) or "", count=1)
    page = title(f"Package {package}") + f".. py:module:: {package}\n\n{text}\n\n"
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
            page += f".. py:data:: {name}\n\n" + indented("\n".join(text))
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
    names = [at.rpartition(".")[2] for at in DESCRIBED.values()]
    short = {name: at for name, at in zip(names, DESCRIBED.values(), strict=True) if names.count(name) == 1}
    for node in list(doctree.findall(addnodes.pending_xref)):
        target = node.get("reftarget", "")
        if node.get("refdomain") == "py" and target not in DESCRIBED.values():
            if at := DESCRIBED.get(target, short.get(target.rpartition(".")[2])):
                node["reftarget"] = at
            else:
                node.replace_self(node.children)


def signature(
    app: Any, what: str, name: str, thing: Any, options: Any, args: str | None, returns: str | None
) -> tuple[str, str | None] | None:
    """Arguments of functions as their source has them, where there is one; those of classes by name alone."""
    if what in ("function", "method") and not thing.__code__.co_filename.startswith("<frozen"):
        node = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
        for each in (node.args.posonlyargs, node.args.args):
            each[:] = [arg for arg in each if arg.arg not in ("self", "cls")]
        return f"({ast.unparse(node.args)})", node.returns and ast.unparse(node.returns).strip("'")
    if what == "class" and args:
        names = [
            p.name if p.default is p.empty else f"{p.name}=..." for p in inspect.signature(thing).parameters.values()
        ]
        return f"({', '.join(names)})", None
    return None


def escape(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Let bars in docstrings be those of norms."""
    lines[:] = [re.sub(r"(`[^`]*`)|\|", lambda found: found[1] or r"\|", line) for line in lines]


def rejoin(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Put the words before a colon back, which napoleon takes for a type of properties and returned values."""
    for line in [line for line in lines if re.match(r":r?type: ", line)]:
        lines.remove(line)
        at = next((k for k, one in enumerate(lines) if one.startswith(":returns: ")), 0)
        field = ":returns: " * lines[at].startswith(":returns: ")
        lines[at] = f"{field}{line.split(': ', 1)[1]}: {lines[at].removeprefix(field)}"


def setup(app: Any) -> dict[str, bool]:
    """Write before pages are looked for."""
    app.connect("config-inited", write)
    app.connect("autodoc-process-docstring", escape, priority=400)
    app.connect("autodoc-process-docstring", rejoin, priority=600)
    app.connect("autodoc-process-signature", signature)
    app.connect("doctree-read", link)
    app.add_lexer("csv", TextLexer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
