# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How Sphinx makes docs/: Markdown pages, the Python reference from the docstrings. No page needs a network."""

from calib_planner import __version__

project = "calib_planner"
author = "calib_planner contributors"
project_copyright = author
version = release = __version__
language = "en"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "examples"]

# Formulas are plain Unicode: nothing is fetched to show them, and they read the same in a terminal.
highlight_language = "text"
smartquotes = False  # --data must not become –data
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
"""Types, shapes, units and frames stand in the docstrings, and in the signatures of the code."""
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
napoleon_use_rtype = False
add_module_names = False
maximum_signature_line_length = 70
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"calib_planner {__version__}"
html_static_path = ["_static"]
html_css_files = ["phone.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}
