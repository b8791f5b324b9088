"""The documentation site: ``make docs``."""

from importlib.metadata import metadata
from importlib.metadata import version as version_of

project = "sb3-maddpg"
author = "The sb3-maddpg developers"
project_copyright = f"2026 {author}"
version = release = version_of("sb3-maddpg")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx-mathjax-offline",
    "sphinxarg.ext",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = "sb3-maddpg"
html_logo = "images/logo.svg"
html_theme_options = {"light_css_variables": {"code-font-size": "0.75rem"}}  # 98 columns fit beside the menu
_urls = dict(one.split(", ", 1) for one in metadata("sb3-maddpg").get_all("Project-URL") or ())
if repository := _urls.get("Repository"):  # `project.urls` in pyproject.toml
    html_theme_options |= {"source_repository": repository, "source_branch": "main", "source_directory": "docs/"}
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_js_files = ["keyboard.js", "tablesort.min.js", "sort.js"]

smartquotes_action = "qe"  # no dashes: options begin with two hyphens
myst_enable_extensions = ["tasklist", "dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # `python -m studies.notebooks` keeps the outputs in the notebooks

autosummary_ignore_module_all = False
autodoc_member_order = "bysource"
maximum_signature_line_length = 88
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "show-inheritance": True}
# Their signatures and docstrings are their own projects'.
autodoc_inherit_docstrings = False
suppress_warnings = ["myst.strikethrough"]


def _headings(app, what, name, obj, options, lines: list[str]) -> None:
    """Gymnasium's environments have Markdown headings in their docstrings."""
    lines[:] = [part for line in lines for part in (("", f"**{line[3:]}**", "") if line.startswith("## ") else (line,))]


def _links(app, docname: str, source: list[str]) -> None:
    """Files that lie above this folder have a page here."""
    folder = "../" * docname.count("/")
    for name in ("CONTRIBUTING", "CHANGELOG"):
        source[0] = source[0].replace(f"]({folder}../{name}.md", f"]({folder}{name.lower()}.md")


def setup(app) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _headings)
    app.connect("source-read", _links)
