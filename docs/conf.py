"""The site: `make docs`."""

import re

import sphinx.application

import sipe_bayes

project = "sipe_bayes"
release = version = sipe_bayes.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
exclude_patterns = ["_build"]
html_theme = "sphinx_book_theme"
html_title = f"sipe_bayes {release}"
html_theme_options = {"show_toc_level": 2}
html_copy_source = False
myst_heading_anchors = 3
OUTSIDE = re.compile(r"(?<!!)\[([^\]]+)\]\((?:\.\./)+((?:examples|results|sipe_bayes|\.github)[^)#]*)(?:#[^)]*)?\)")


def name_files(app: sphinx.application.Sphinx, page: str, source: list[str]) -> None:
    """Links to files of the repository, which the site does not hold, become their names."""
    source[0] = OUTSIDE.sub(lambda m: f"`{m[2]}`" if m[2] in m[1] else f"{m[1]} (`{m[2]}`)", source[0])


def setup(app: sphinx.application.Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("source-read", name_files)
