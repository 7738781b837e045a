"""Print the lowest versions that `pyproject.toml` allows, those of the tests included, for `pip install`."""

import re
import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
for requirement in [*project["dependencies"], *project["optional-dependencies"]["test"]]:
    lowest = re.fullmatch(r"([A-Za-z0-9_.-]+(?:\[[a-z,]+\])?)>=([0-9.]+)(,[<!=0-9.,*]+)?", requirement)
    if lowest is None:
        sys.exit(f"{requirement}: expected NAME>=VERSION, which says what the lowest is")
    print(f"{lowest[1]}=={lowest[2]}")
