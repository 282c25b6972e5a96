"""Sphinx configuration: `make docs` builds the site from this folder."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
# Documents this checkout, even if another one is installed.
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext")]

import armscan

project = "armscan"
author = "The armscan authors"
version = release = armscan.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_click",
    "sphinx_copybutton",
    "sphinx_design",
    "configuration_reference",
    "local_plotly",
    "markdown_docstrings",
    "mathml",
]
exclude_patterns = ["_build", "_ext"]
# Options (--plan) and quotes are shown as they are typed.
smartquotes = False

# Markdown
myst_enable_extensions = ["attrs_block", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
# Notebooks are run by tests/test_docs.py and kept with their outputs.
nb_execution_mode = "off"
nb_merge_streams = True
# Charts are there as HTML, too.
suppress_warnings = ["mystnb.unknown_mime_type"]

# API
default_role = "code"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
toc_object_entries = False
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "imported-members": True, "undoc-members": False}
napoleon_numpy_docstring = False
napoleon_use_rtype = False

# Pages
html_theme = "furo"
html_title = "armscan"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_show_sphinx = False
copybutton_prompt_text = "$ "
