"""Imports run one way, only the command line prints, no global generator is drawn from, public names are explained."""

import ast
import inspect
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import fg_calib

PACKAGE = Path(fg_calib.__file__).parent
FOLDERS = (
    "inputs", "parallel", "robot", "initialization", "measurements", "job", "graph", "observability", "statistics",
    "prediction", "diagnostics", "monitoring", "selection", "assessment", "baseline", "io", "simulation", "designs",
    "importers", "report", "calibration", "batch", "exports", "cli"
)  # fmt: skip
"""From the ground up: a folder (or module of the package itself) imports from those before it."""

MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p.name != "__init__.py" and "examples" not in p.parts)
NAMES = [p.relative_to(PACKAGE).with_suffix("").as_posix() for p in MODULES]


def found_in_modules(check):
    """What a check finds in each module, by name, where it finds any."""
    found = {name: check(name, path) for name, path in zip(NAMES, MODULES, strict=True)}
    return {name: what for name, what in found.items() if what}


@cache
def parse(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def nodes(path):
    """All that a module is made of."""
    return list(ast.walk(parse(path)))


def offered(folder):
    """The module that has each name of a folder's front, as its stub says: `{"robot/Robot": "robot/model"}`."""
    stub = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    found = [(alias.name, node.module) for node in imports for alias in node.names]
    return {f"{folder.name}/{name}": f"{folder.name}/{module}" for name, module in found}


FRONTS = {name: home for stub in PACKAGE.glob("*/__init__.pyi") for name, home in offered(stub.parent).items()}


@cache
def imported(tree):
    """Modules of the package that a module imports anywhere, as paths below the package: `robot`, `io/yaml`."""
    found = set()
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            first, *rest = name.split(".")
            if first == "fg_calib":
                path = "/".join(rest)
                path = FRONTS.get(path, path)
                while path and not (PACKAGE / f"{path}.py").is_file() and not (PACKAGE / path).is_dir():
                    path = path.rpartition("/")[0]  # the last word names something in the module
                found.add(path)
    return found - {""}  # "" is the package itself: __version__


def floor(name):
    return FOLDERS.index(name.partition("/")[0])


def test_every_module_stands_in_a_folder():
    assert {name.partition("/")[0] for name in NAMES} == set(FOLDERS)


def test_a_folder_imports_from_lower_ones_only():
    def upward(name, path):
        return {other for other in imported(parse(path)) if floor(other) > floor(name)}

    assert found_in_modules(upward) == {}


def test_no_modules_import_each_other_in_a_circle():
    graph = {name: imported(parse(path)) for name, path in zip(NAMES, MODULES, strict=True)}
    assert list(TopologicalSorter(graph).static_order())


def test_upward_imports_would_be_seen():
    """The check itself: all forms of an import, wherever they stand."""
    code = "import fg_calib.cli\ndef f():\n from fg_calib.graph import solver\n from fg_calib.io.yaml import Units"
    assert imported(ast.parse(code)) == {"cli", "graph/solver", "io/yaml"}
    assert floor("graph/solver") < floor("io/yaml") < floor("cli")


def test_the_baseline_shares_nothing_with_the_graph_but_residuals():
    """So that agreement of the two says something: neither problem, factors and solver nor what assesses them."""
    used = {"baseline/least_squares"}
    while more := {other for name in used for other in imported(parse(PACKAGE / f"{name}.py"))
                   if other.startswith("baseline/")} - used:  # fmt: skip
        used |= more
    others = {other for name in used for other in imported(parse(PACKAGE / f"{name}.py"))} - used
    of_folders = {other.partition("/")[0] for other in others}
    assert of_folders == {"inputs", "robot", "measurements", "parallel"}


@cache
def libraries(path):
    """First words of all that a module imports."""
    of_import = {a.name for node in nodes(path) if isinstance(node, ast.Import) for a in node.names}
    of_from = {node.module or "" for node in nodes(path) if isinstance(node, ast.ImportFrom)}
    return {name.partition(".")[0] for name in of_import | of_from}


@cache
def calls(path):
    """Every call of a module: `[("np.array", 1)]`, the function and how many arguments stand without a name."""
    return [(ast.unparse(node.func), len(node.args)) for node in nodes(path) if isinstance(node, ast.Call)]


def test_a_function_is_seen_whole_on_a_screen():
    def long(_, path):
        functions = [node for node in nodes(path) if isinstance(node, ast.FunctionDef)]
        return {f.name for f in functions if f.end_lineno - f.lineno + 1 > 60}

    assert found_in_modules(long) == {}


def test_only_the_command_line_prints():
    printing = found_in_modules(lambda _, path: any(function == "print" for function, _ in calls(path)))
    assert {name for name in printing if not name.startswith("cli/")} == set()


def test_no_input_can_run_code_or_reach_a_network():
    """What `docs/security.md` says: no pickles, and YAML goes through one safe loader."""
    dangerous = {"eval", "exec", "compile", "__import__", "os.system", "yaml.unsafe_load", "yaml.full_load"}
    assert found_in_modules(lambda _, path: dangerous & {function for function, _ in calls(path)}) == {}
    assert set(found_in_modules(lambda _, path: any(f == "yaml.load" for f, _ in calls(path)))) == {"io/yaml"}
    forbidden = {"pickle", "marshal", "shelve", "subprocess", "urllib", "http", "requests", "ctypes", "multiprocessing"}
    assert found_in_modules(lambda _, path: forbidden & libraries(path)) == {"parallel": {"multiprocessing"}}


def test_no_module_uses_global_random_state():
    """`np.random.default_rng` with a seed, and the type `Generator`, are all of numpy.random there is."""
    numpys = re.compile(r"random\.(?!default_rng|Generator)\w+$")
    attributes = lambda path: [ast.unparse(n) for n in nodes(path) if isinstance(n, ast.Attribute)]  # noqa: E731
    assert found_in_modules(lambda _, path: [a for a in attributes(path) if numpys.search(a)]) == {}
    assert found_in_modules(lambda _, path: "random" in libraries(path)) == {}
    seedless = found_in_modules(lambda _, path: any(f.endswith("default_rng") and not n for f, n in calls(path)))
    assert seedless == {}

    def drawn_at_import(_, path):
        outside = [s for s in parse(path).body if not isinstance(s, ast.FunctionDef | ast.ClassDef)]
        called = [ast.unparse(n.func) for s in outside for n in ast.walk(s) if isinstance(n, ast.Call)]
        return [function for function in called if "random" in function]

    assert found_in_modules(drawn_at_import) == {}


@pytest.mark.parametrize("name", fg_calib.__all__)
def test_a_public_name_is_a_class_or_function_that_is_explained(name):
    public = getattr(fg_calib, name)
    assert inspect.isclass(public) or inspect.isfunction(public)
    assert (public.__doc__ or "").strip()
    assert public.__module__.startswith("fg_calib.")


def test_public_names_are_listed_once_and_in_order():
    assert fg_calib.__all__ == sorted(set(fg_calib.__all__))
    assert len(fg_calib.__all__) <= 40
    assert set(fg_calib.__all__) <= set(dir(fg_calib))


def run_python(code):
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    return ended.stdout


@pytest.mark.slow
def test_public_names_come_from_a_fresh_import():
    code = "from fg_calib import *; import fg_calib, types; "
    code += "print([n for n in fg_calib.__all__ if isinstance(globals()[n], types.ModuleType)])"
    assert run_python(code) == "[]\n"


def test_all_that_is_imported_is_installed_with_the_package():
    """What the tests need besides, such as yourdfpy, is not; an extra is imported by one module."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    installed = {re.match(r"[\w-]+", line)[0] for line in project["dependencies"]}
    as_imported = {"yaml", "pydantic_core", "markupsafe"}  # pydantic and jinja2 bring the latter
    installed = {name.replace("-", "_") for name in installed} - {"pyyaml"} | as_imported
    used = {"lazy_loader": {"the folders' fronts"}}
    for name, path in zip(NAMES, MODULES, strict=True):
        for library in libraries(path):
            used.setdefault(library, set()).add(name)
    extras = {"camera": ("opencv-python-headless", "cv2", "importers/board"),
              "ros": ("rosbags", "rosbags", "importers/bag")}  # fmt: skip
    for extra, (distribution, module, name) in extras.items():
        assert [re.match(r"[\w-]+", line)[0] for line in project["optional-dependencies"][extra]] == [distribution]
        assert used.pop(module) == {name}
    assert set(used) - sys.stdlib_module_names - {"fg_calib"} == installed


def test_the_command_line_is_there_before_the_heavy_libraries():
    code = "import sys, fg_calib.cli; print(sorted({m.partition('.')[0] for m in sys.modules}))"
    loaded = set(ast.literal_eval(run_python(code)))
    assert "fg_calib" in loaded
    heavy = {"gtsam", "numba", "polars", "scipy", "numpy", "matplotlib", "lxml", "pydantic"}
    assert loaded & heavy == set()


@pytest.mark.slow
def test_a_calibration_loads_only_what_it_uses(example):
    """No figures, pages, URDFs or baseline, of scipy not the heaviest, and nothing that is for new rows or folds."""
    code = f"""
import contextlib, io, sys
from fg_calib import cli
sys.argv = ["fg-calib", "calibrate", {str(example / "calibration.yaml")!r}]
sys.stderr = io.StringIO()  # which says so if kernels are compiled
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    cli.main()
print(sorted(sys.modules))
"""
    loaded = set(ast.literal_eval(run_python(code)))
    assert {"fg_calib.assessment", "fg_calib.report.text", "gtsam", "numba", "polars"} <= loaded
    idle = {"matplotlib", "lxml", "yourdfpy", "scipy.optimize", "scipy.stats"}
    idle |= {"fg_calib.baseline", "fg_calib.importers.bag", "fg_calib.simulation.simulator", "jinja2", "cv2", "rosbags"}
    assert loaded & idle == set()


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No fg_calib attribute calibrate_all"):
        _ = fg_calib.calibrate_all
