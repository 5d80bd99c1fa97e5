"""Add pages from outside of docs/ to the site, and report links that lead nowhere.

README, CONTRIBUTING, CHANGELOG and the GPU log are written for the repository; here they become
pages. A link to a file that is no page, such as a module, becomes plain text if the file exists.
"""

import logging
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/GPU_LOG.md": "gpu_log.md",
}
_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
_CODE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
log = logging.getLogger("mkdocs.hooks")


def for_site(text: str, source: str) -> str:
    """Rewrite the links of the page at the path `source` of the repository for the site."""
    home = posixpath.dirname(PAGES.get(source) or source.removeprefix("docs/"))

    def link(found: re.Match) -> str:
        mark, words, target, anchor = found.groups()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if not (ROOT / path).exists():
            log.warning("%s links to %s, which is not there", source, target)
        page = PAGES.get(path) or (path.startswith("docs/") and path.removeprefix("docs/"))
        if not page:
            return words
        return f"{mark}[{words}]({posixpath.relpath(page, home or '.')}{anchor or ''})"

    parts = _CODE.split(text)
    parts[::2] = [_LINK.sub(link, part) for part in parts[::2]]
    return "".join(parts)


def on_files(files, config):
    """Add the pages from outside of docs/."""
    for source, page in PAGES.items():
        text = for_site((ROOT / source).read_text(encoding="utf-8"), source)
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown, page, **_):
    """Rewrite the links of a page of docs/."""
    inside = page.file.src_uri not in PAGES.values()
    return for_site(markdown, f"docs/{page.file.src_uri}") if inside else markdown
