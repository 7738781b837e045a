"""What the package is made of: lines, long functions, imports, and how often code asks for the kind of a measurement.

    python experiments/structure.py [FOLDER]

FOLDER is another checkout's root, to compare with.
"""

import ast
import re
import sys
from itertools import chain
from pathlib import Path

ASKS = re.compile(
    r"uses_pairs|PAIR_(KINDS|MODELS)|POSE_(KINDS|MODELS)|(pairs|points) is (not )?None|judgement is|same_point\b"
    r"|isinstance\([^)]*(Pair(Block|Whitening|Noise)|Pose(Block|Whitening)|SamePoint|TouchedPoint)"
    r"|with_(distance|angle|orientation|position)|\.kind\.ends|n_nuisances|in \(\"distance\", \"angle\"\)"
)
"""A line of code with one of these asks for the kind; the names before and after the core was rebuilt."""

CORE = ("problem", "whitening", "residuals", "residual_table", "goodness", "predictions", "noise", "rows", "factors",
        "covariance", "uncertainty", "joint_values", "encoders", "joints", "groups", "points", "information", "build",
        "start", "solver", "extension", "variance_components")  # fmt: skip
"""Modules between the tables and the report, by either's names."""


def imported(package: Path, file: Path) -> set[str]:
    """Modules of the package that a module imports anywhere, as paths below the package."""
    nodes = list(ast.walk(ast.parse(file.read_text())))
    names = chain(
        (alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names),
        (f"{n.module}.{alias.name}" for n in nodes if isinstance(n, ast.ImportFrom) for alias in n.names),
    )
    found = set()
    for first, *rest in (name.split(".") for name in names):
        while first == "fg_calib" and rest and not (package / "/".join(rest)).with_suffix(".py").is_file():
            rest.pop()
        if first == "fg_calib" and rest:
            found.add("/".join(rest))
    return found


WALK = (("graph/build", "build_problem"), ("graph/solver", "solve"), ("analysis/uncertainty", "assess"),
        ("report/text", "build_report"))  # fmt: skip
"""The way that `measurements` take through the package, from the problem to the report."""


def rooms(package: Path) -> list[str]:
    """Modules in the order in which a reader enters them who follows calls from `WALK`'s functions on, depth first.

    Every function is read once, where it is first called in the order of the code. Calls by name are followed, of what
    the module defines or imports from the package (of classes the constructor and `__post_init__`); methods of objects
    are not, as no name says where they live. Going back to the caller is no entry, going on to another module is one.
    """
    trees = {f.relative_to(package).with_suffix("").as_posix(): ast.parse(f.read_text()) for f in package.rglob("*.py")}
    homes: dict[str, dict[str, tuple[str, str]]] = {}  # module: name: where it is defined
    for module, tree in trees.items():
        homes[module] = {n.name: (module, n.name) for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fg_calib."):
                home = node.module.removeprefix("fg_calib.").replace(".", "/")
                for alias in node.names:
                    homes[module][alias.asname or alias.name] = (home, alias.name)
                    homes[module][f"{alias.asname or alias.name}."] = (f"{home}/{alias.name}", "")  # a module, perhaps

    def body_of(module: str, name: str) -> list[ast.stmt]:
        for node in trees[module].body if module in trees else []:
            if isinstance(node, ast.FunctionDef) and node.name == name:
                return node.body
            if isinstance(node, ast.ClassDef) and node.name == name:
                made = ("__init__", "__post_init__")
                return [s for f in node.body if isinstance(f, ast.FunctionDef) and f.name in made for s in f.body]
        return []

    read, entered = set(), []

    def follow(module: str, name: str) -> None:
        body = body_of(module, name)
        if (module, name) in read or not body:
            return
        read.add((module, name))
        if not entered or entered[-1] != module:
            entered.append(module)
        calls = [n for s in body for n in ast.walk(s) if isinstance(n, ast.Call)]
        for call in sorted(calls, key=lambda n: (n.end_lineno, n.end_col_offset)):
            match call.func:
                case ast.Name(id=called) if called in homes[module]:
                    follow(*homes[module][called])
                case ast.Attribute(value=ast.Name(id=of), attr=called) if f"{of}." in homes[module]:
                    follow(homes[module][f"{of}."][0], called)

    for module, name in WALK:
        follow(module, name)
    return entered


def main() -> None:
    """Print the figures."""
    package = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1]) / "fg_calib"
    files = sorted(package.rglob("*.py"))
    asks, lines, long = {}, {}, []
    for file in files:
        text, name = file.read_text(), file.relative_to(package).with_suffix("").as_posix()
        lines[name] = text.count("\n")
        code = [line for line in text.split("\n") if not line.strip().startswith(("#", '"""', "from ", "import "))]
        asks[name] = sum(bool(ASKS.search(line)) for line in code)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= 60:
                long.append(f"{name}.{node.name}")
    arrows = {(name, other) for name, file in zip(lines, files, strict=True) for other in imported(package, file)}
    within = {tuple(module.partition("/")[0] for module in arrow) for arrow in arrows}
    both_ways = {frozenset(arrow) for arrow in within if arrow[0] != arrow[1] and arrow[::-1] in within}
    of_core = {name: n for name, n in asks.items() if name.rpartition("/")[2] in CORE and n}
    print(f"{len(files)} modules, {sum(lines.values())} lines; the longest: {sorted(lines.values())[-5:]}")
    print(f"lines that ask for the kind: {sum(asks.values())} in {sum(n > 0 for n in asks.values())} modules")
    print(f"of the core: {sum(of_core.values())} in {len(of_core)}: {of_core}")
    between = sum(first != second for first, second in within)
    print(f"import arrows: {len(arrows)} between modules, {len(arrows) / len(files):.1f} a module")
    print(f"of folders and modules beside them: {between}, {len(both_ways)} of them both ways")
    entered = rooms(package)
    again, folders = len(entered) - len(set(entered)), [module.partition("/")[0] for module in entered]
    through = [folder for k, folder in enumerate(folders) if k == 0 or folders[k - 1] != folder]
    print(f"rooms entered from build_problem to the report: {len(set(entered))}, and entered again: {again}")
    print(f"folders entered on that way: {len(set(through))}, and entered again: {len(through) - len(set(through))}")
    print(f"functions over 60 lines: {len(long)}: {', '.join(long)}")


if __name__ == "__main__":
    main()
