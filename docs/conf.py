"""The site: `make docs`.

Pages with code cells are run when it is built, as notebooks. What they gave is kept in `_build` for as long as neither
they nor the package change.
"""

import hashlib
import os
import re
from pathlib import Path

import sphinx.application

import sipe_bayes

project = "sipe_bayes"
release = version = sipe_bayes.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
exclude_patterns = ["_build", "jupyter_execute"]
html_theme = "sphinx_book_theme"
html_title = f"sipe_bayes {release}"
html_theme_options = {"show_toc_level": 2, "navbar_persistent": []}  # the search stands in the sidebar
html_context = {"default_mode": "auto"}
html_copy_source = False
myst_heading_anchors = 3
ROOT = Path(__file__).parents[1]
SOURCES = sorted(p for name in ("sipe_bayes", "examples", "results") for p in (ROOT / name).rglob("*") if p.is_file())
CODE = [
    p for p in (*SOURCES, ROOT / "constraints.txt") if p.suffix in (".py", ".toml", ".xml", ".csv", ".json", ".txt")
]
VERSION = hashlib.sha256(b"".join(path.read_bytes() for path in CODE)).hexdigest()[:16]
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parent / "_build" / f".run-{VERSION}")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 240
nb_merge_streams = True
os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"  # tqdm's, of a notebook without ipywidgets
OUTSIDE = re.compile(
    r"(?<!!)\[([^\]]+)\]\((?:\.\./)+((?:examples|results|sipe_bayes|SECURITY|\.github)[^)#]*)(?:#[^)]*)?\)"
)


def name_files(app: sphinx.application.Sphinx, page: str, source: list[str]) -> None:
    """Links to files of the repository, which the site does not hold, become their names."""
    source[0] = OUTSIDE.sub(lambda m: f"`{m[2]}`" if m[2] in m[1] else f"{m[1]} (`{m[2]}`)", source[0])


def setup(app: sphinx.application.Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("source-read", name_files)
