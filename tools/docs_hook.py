"""Hook of MkDocs: pages link to files of the repository beside ``docs``, and the site carries copies of those.

In the repository ``../examples/own_task.py`` leads to the file itself, in the site to ``source/examples/own_task.py``.
"""

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")


def outside(page: str, link: str) -> str | None:
    """Path in the repository of a file beside ``docs`` that ``link`` on ``page`` leads to; None for other links."""
    if "://" in link or not link.startswith("../"):
        return None
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), link))
    return None if path.startswith(("docs/", "../")) else path


def on_files(files: Files, config: Any) -> Files:
    """Add the changelog as a page, and every file beside ``docs`` that a page links to."""
    files.append(File.generated(config, "changelog.md", content=(ROOT / "CHANGELOG.md").read_text()))
    for page in [file for file in files if file.is_documentation_page()]:
        for link in LINK.finditer(page.content_string):
            path = outside(page.src_uri, link[2])
            if path and not files.get_file_from_path(f"source/{path}"):
                files.append(File.generated(config, f"source/{path}", abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead such links to the copies."""

    def led(link: re.Match[str]) -> str:
        path = outside(page.file.src_uri, link[2])
        if path is None:
            return link[0]
        return link[1] + posixpath.relpath(f"source/{path}", posixpath.dirname(page.file.src_uri) or ".") + link[3]

    return LINK.sub(led, markdown)
