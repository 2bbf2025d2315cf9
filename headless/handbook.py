# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the artists' handbook as HTML pages: `package.py` adds them to the extension, whose buttons open them.

Links to other parts of docs, which the extension does not have, become plain text.
"""
from __future__ import annotations

import html
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 46em; margin: 2em auto; padding: 0 1em; color: #222; }
img { max-width: 100%; } code { background: #eee; padding: 0 .2em; } pre { background: #eee; padding: .6em; }
table { border-collapse: collapse; margin: 1em 0; } nav { margin-bottom: 2em; }
td, th { border: 1px solid #ccc; padding: .3em .6em; text-align: left; vertical-align: top; }
"""
_MARKDOWN = MarkdownIt("commonmark", {"breaks": True, "html": False}).enable("table")
"""CommonMark with tables; the line breaks of a paragraph are kept."""
_MARKDOWN.add_render_rule(
    "code_block", lambda _, tokens, index, *__: f"<pre>{html.escape(tokens[index].content)}</pre>\n")


def render_pages(source: Path) -> dict[str, bytes]:
    """Return the files of the handbook by name: a page for each document of the folder `source`, and its pictures.

    README.md becomes index.html.
    """
    documents = sorted(source.glob("*.md"))
    titles = {_page_name(path.name): _title(path) for path in documents}
    files = {_page_name(path.name): _render_page(path.read_text(encoding="utf-8"), titles).encode()
             for path in documents}
    for picture in sorted((source / "pictures").iterdir()):
        files[f"pictures/{picture.name}"] = picture.read_bytes()
    return files


def _page_name(name: str) -> str:
    return "index.html" if name == "README.md" else f"{Path(name).stem}.html"


def _title(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")


def _render_page(text: str, titles: dict[str, str]) -> str:
    """Return the HTML page of a Markdown text, with links to all pages. titles: of all pages, by file name."""
    links = " · ".join(f'<a href="{name}">{html.escape(title)}</a>'
                       for name, title in sorted(titles.items(), key=lambda item: item[0] != "index.html"))
    title = html.escape(text.splitlines()[0].removeprefix("# "))
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style></head><body>\n<nav>{links}</nav>\n{_render_body(text)}\n</body></html>\n")


def _render_body(text: str) -> str:
    """Return the HTML of a document: headings have the ids that links in Markdown name, and links lead to pages."""
    tokens = _MARKDOWN.parse(text)
    for token, following in pairwise(tokens):
        if token.type == "heading_open":
            token.attrSet("id", _anchor(following.content))
        token.children = _link_to_pages(token.children or []) or token.children
    return str(_MARKDOWN.renderer.render(tokens, _MARKDOWN.options, {}))


def _anchor(heading: str) -> str:
    """Return the id of a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _link_to_pages(tokens: Sequence[Token]) -> list[Token]:
    """Return inline tokens with links to Markdown files turned into links to pages; links that leave the handbook
    become plain text."""
    result, leaves_handbook = [], False
    for token in tokens:
        if token.type == "link_open":
            path, hash_mark, anchor = str(token.attrGet("href")).partition("#")
            leaves_handbook = path.startswith("..") or "/" in path
            token.attrSet("href", f"{_page_name(path) if path else ''}{hash_mark}{anchor}")
        if not (leaves_handbook and token.type in ("link_open", "link_close")):
            result.append(token)
    return result
