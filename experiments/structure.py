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
    print(f"functions over 60 lines: {len(long)}: {', '.join(long)}")


if __name__ == "__main__":
    main()
