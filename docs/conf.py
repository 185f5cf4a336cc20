"""Settings of the documentation site: `make docs` builds it to build/site, and every warning is an error."""

from __future__ import annotations

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

from tactile_bayes import __version__  # noqa: E402

project = "tactile_bayes"
author = "The tactile_bayes maintainers"
project_copyright = author
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "extension.python_pages"]
exclude_patterns = ["extension"]
root_doc = "index"

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

default_role = "literal"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
toc_object_entries = False  # the sidebar of every page would repeat them all
napoleon_google_docstring = False
python_use_unqualified_type_names = True
# Names in signatures: other projects' are not linked (the build uses no network), and a type that is private or an
# alias has no entry of its own.
nitpick_ignore_regex = [("py:.*", ".*")]

suppress_warnings = ["ref.python"]  # a word such as "columns" in a shape is a field of two classes

html_theme = "furo"
html_title = "tactile_bayes"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"top_of_page_buttons": []}
