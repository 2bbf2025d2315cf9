# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the artists' handbook as HTML pages: `package.py` adds them to the extension, whose buttons open them.

It knows the Markdown of docs/handbook: headings, paragraphs, lists, tables, pictures, links, code and emphasis. Links
to other parts of docs, which the extension does not have, become plain text.
"""
from __future__ import annotations

import html
import re
from collections.abc import Iterator
from pathlib import Path

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 46em; margin: 2em auto; padding: 0 1em; color: #222; }
img { max-width: 100%; } code { background: #eee; padding: 0 .2em; } pre { background: #eee; padding: .6em; }
table { border-collapse: collapse; margin: 1em 0; } nav { margin-bottom: 2em; }
td, th { border: 1px solid #ccc; padding: .3em .6em; text-align: left; vertical-align: top; }
"""
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
_INLINE = ((re.compile(r"\*\*(.+?)\*\*"), r"<strong>\1</strong>"), (re.compile(r"\*(.+?)\*"), r"<em>\1</em>"))
_BLOCK_START = re.compile(r"#|\||\d+\. |- |    ")


def write_pages(source: Path) -> dict[str, bytes]:
    """Return the files of the handbook by name: a page for each document of the folder `source`, and its pictures.

    README.md becomes index.html.
    """
    documents = sorted(source.glob("*.md"))
    titles = {_page_name(path.name): _title(path) for path in documents}
    files = {_page_name(path.name): _page(path.read_text(encoding="utf-8"), titles).encode() for path in documents}
    for picture in sorted((source / "pictures").iterdir()):
        files[f"pictures/{picture.name}"] = picture.read_bytes()
    return files


def _page_name(name: str) -> str:
    return "index.html" if name == "README.md" else f"{Path(name).stem}.html"


def _title(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")


def _page(text: str, titles: dict[str, str]) -> str:
    """Return a whole page; titles: those of all pages, by file name."""
    links = " · ".join(f'<a href="{name}">{html.escape(title)}</a>'
                       for name, title in sorted(titles.items(), key=lambda item: item[0] != "index.html"))
    body = "\n".join(_blocks(text.splitlines()))
    title = html.escape(text.splitlines()[0].removeprefix("# "))
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style></head><body>\n<nav>{links}</nav>\n{body}\n</body></html>\n")


def _blocks(lines: list[str]) -> Iterator[str]:
    """Yield the HTML of each block of a document; the line breaks of a paragraph are kept."""
    at = 0
    while at < len(lines):
        line = lines[at]
        if not line.strip():
            at += 1
        elif line.startswith("#"):
            level = len(line) - len(line.lstrip("#"))
            name = line.lstrip("# ")
            yield f'<h{level} id="{_anchor(name)}">{_inline(name)}</h{level}>'
            at += 1
        elif line.startswith("|"):
            end = _end(lines, at, "|")
            yield _table(lines[at:end])
            at = end
        elif match := re.match(r"\d+\. |- ", line):
            kind, pattern = ("ul", "- ") if match[0] == "- " else ("ol", r"\d+\. ")
            end = at
            while end < len(lines) and re.match(pattern, lines[end]):
                end += 1
            items = "".join(f"<li>{_inline(re.sub(pattern, '', item, count=1))}</li>" for item in lines[at:end])
            yield f"<{kind}>{items}</{kind}>"
            at = end
        elif line.startswith("    "):
            end = _end(lines, at, "    ")
            yield f"<pre>{html.escape(chr(10).join(item[4:] for item in lines[at:end]))}</pre>"
            at = end
        else:
            end = at + 1
            while end < len(lines) and lines[end].strip() and not _BLOCK_START.match(lines[end]):
                end += 1
            yield f"<p>{'<br>'.join(map(_inline, lines[at:end]))}</p>"
            at = end


def _end(lines: list[str], begin: int, prefix: str) -> int:
    """Return the index after the lines from `begin` that start with a prefix."""
    end = begin
    while end < len(lines) and lines[end].startswith(prefix):
        end += 1
    return end


def _table(lines: list[str]) -> str:
    """Return a table; its second line separates the head."""
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
    head, body = rows[0], rows[2:]
    parts = ["".join(f"<th>{_inline(cell)}</th>" for cell in head)]
    parts += ["".join(f"<td>{_inline(cell)}</td>" for cell in row) for row in body]
    return "<table>" + "".join(f"<tr>{part}</tr>" for part in parts) + "</table>"


def _anchor(heading: str) -> str:
    """Return the id of a heading, as links in Markdown name it."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _inline(text: str) -> str:
    """Return the HTML of text within a block; code stays as it is."""
    parts = text.split("`")  # every second part is code
    return "".join(f"<code>{html.escape(part)}</code>" if number % 2 else _emphasis(part)
                   for number, part in enumerate(parts))


def _emphasis(text: str) -> str:
    """Return the HTML of text without code: links, pictures, bold and italic."""
    escaped = _LINK.sub(_link, html.escape(text, quote=False))
    for pattern, replacement in _INLINE:
        escaped = pattern.sub(replacement, escaped)
    return escaped


def _link(match: re.Match[str]) -> str:
    """Return the HTML of a link or a picture; a link that leaves the handbook becomes its text."""
    picture, label, target = match.groups()
    if picture:
        return f'<img src="{target}" alt="{label}">'
    path, hash_, anchor = target.partition("#")
    if path.startswith("..") or "/" in path:
        return label
    return f'<a href="{_page_name(path) if path else ""}{hash_}{anchor}">{label}</a>'
