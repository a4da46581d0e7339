"""Fill the templates and lock the page: nothing but our own style and script can take effect."""

from __future__ import annotations

import base64
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from brainbench.core.files import to_plain
from leaderboards import text as words
from leaderboards.figures.rdms import colour_stops
from leaderboards.standing import MEANINGS

_TEMPLATES = Path(__file__).parents[1] / "templates"


def render(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped, under a content security policy.

    The policy names our style and script by their hash, so even markup that slipped past the
    escaping could not run, load or send anything.
    """
    style = (_TEMPLATES / "page.css").read_text(encoding="utf-8")
    script = (_TEMPLATES / "page.js").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_source_hash(style)}'; script-src '{_source_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    page = _environment().get_template(template)
    return page.render(**values, policy=policy, style=Markup(style), script=Markup(script))


def render_markdown(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped for Markdown, and for the HTML that Markdown may hold."""
    environment = _environment().overlay(autoescape=False, finalize=escape_markdown)
    return environment.get_template(template).render(**values)


_MARKDOWN = str.maketrans({mark: f"\\{mark}" for mark in "\\`*_{}[]|#!"} | {"<": "&lt;", ">": "&gt;"})


def escape_markdown(value: Any) -> Any:
    """Return a value as text of one line that Markdown, and the HTML in it, take literally; markup stays as it is."""
    return value if isinstance(value, Markup) else " ".join(str(value).translate(_MARKDOWN).split())


def script_json(value: Any) -> Any:
    """Return ``value`` as JSON that can stand inside a script element: nothing in it can end the element."""
    text = json.dumps(to_plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark, escaped in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026")):
        text = text.replace(mark, escaped)
    return Markup(text)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    helpers = (words.number, words.probability, words.count, words.span, words.level)
    environment.filters |= {helper.__name__: helper for helper in helpers}
    environment.globals |= {"STANDING": MEANINGS, "SYNTHETIC": words.SYNTHETIC, "p_sentence": words.p_sentence}
    environment.globals["colour_stops"] = colour_stops()
    return environment


def _source_hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
