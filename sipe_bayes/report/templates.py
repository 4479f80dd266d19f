"""Jinja environments: one way in which every report's template is found and read."""

from __future__ import annotations

from collections.abc import Callable

import jinja2
from markupsafe import Markup, escape


def html_templates(*packages: str) -> jinja2.Environment:
    """Templates of HTML pages: what is put in is escaped, and a name that is missing is an error.

    Args:
        *packages: whose folders of templates are looked through, in order.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package, "templates") for package in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    return environment


def breakable(name: str) -> Markup:
    """A name for HTML that may be broken into lines after its underscores."""
    return Markup("_<wbr>").join(escape(part) for part in name.split("_"))


def latex_templates(package: str, escape: Callable[[object], str]) -> jinja2.Environment:
    """Templates of LaTeX documents, with ``<% %>``, ``<< >>`` and ``<# #>`` in place of braces."""
    return html_templates(package).overlay(
        autoescape=False,
        finalize=escape,
        block_start_string="<%",
        block_end_string="%>",
        variable_start_string="<<",
        variable_end_string=">>",
        comment_start_string="<#",
        comment_end_string="#>",
    )
