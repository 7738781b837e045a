"""The documentation site: `sphinx-build -W --keep-going -n docs docs/_build/html`. It needs no network."""

import sys
from pathlib import Path

from fg_calib import __version__

sys.path.append(str(Path(__file__).parent / "_ext"))

project = "fg_calib"
author = "the authors of fg_calib"
release = version = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "repository", "reference", "mathml"]
exclude_patterns = ["_build", "_ext", "jupyter_execute", "**.ipynb_checkpoints"]

html_theme = "furo"
html_title = f"fg_calib {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "_ext/scorer.js")
html_show_copyright = html_copy_source = html_show_sourcelink = False
html_math_renderer = "mathml"
pygments_style, pygments_dark_style = "default", "github-dark"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

nb_execution_mode = "auto"
nb_execution_raise_on_error = True
nb_execution_timeout = 300

default_role = "code"  # docstrings write names in single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # `reference` writes them as the source does
autodoc_default_options = {"members": True, "inherited-members": False}
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar, napoleon_attr_annotations = True, False
toc_object_entries = False  # the navigation would hold every method
nitpicky = True
