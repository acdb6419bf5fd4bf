"""Settings of the documentation site: `make docs`.

The source folder is the repository's root, so that a link between two files is the same here and on a code host.
"""

import sys
from pathlib import Path

from docutils.nodes import document
from pygments.lexers import TextLexer
from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

project = "flcav"
copyright = "the flcav maintainers, Apache-2.0"
root_doc = "docs/index"
include_patterns = ["docs/**", "reproductions/**", "CONTRIBUTING.md", "CHANGELOG.md"]
source_suffix = {".md": "markdown"}
extensions = ["myst_parser", "sphinx.ext.autodoc", "public_names"]

myst_heading_anchors = 3  # as code hosts name them
myst_enable_extensions = ["deflist"]

suppress_warnings = ["ref.python"]  # `Task` in a signature: more than one package has one

highlight_language = "none"  # of a block that names none: commands of a shell, drawings
default_role = "literal"  # docstrings are plain text with `code`
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
maximum_signature_line_length = 100

html_theme = "furo"
html_title = "flcav"
html_copy_source = False
html_show_sphinx = False
html_extra_path = ["site"]  # index.html of the folder, which leads to the first page
html_static_path = ["static"]
html_css_files = ["site.css"]


def setup(app: Sphinx) -> None:
    """Let tables stand in code blocks: `csv` is no language that is known to be coloured; leave changes unsearched."""
    app.add_lexer("csv", TextLexer)
    app.connect("doctree-read", leave_unsearched)


def leave_unsearched(app: Sphinx, doctree: document) -> None:
    """Keep the changelog out of the site's search, whose words stand in the pages of what changed."""
    if app.env.docname == "CHANGELOG":
        app.env.metadata["CHANGELOG"]["nosearch"] = ""
