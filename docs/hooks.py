"""Brings pages from outside of docs/ into the site, and says where a link leads nowhere.

README, CONTRIBUTING, CHANGELOG and the GPU log are written to be read in the repository; here they
become pages. A link to a file that is no page, such as a module, keeps its words and loses its
target, after a look at whether the file is there.
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
    """A page of the repository, at the path `source` in it, with links as the site has them."""

    def link(found: re.Match) -> str:
        mark, words, target, anchor = found.groups()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if not (ROOT / path).exists():
            log.warning("%s links to %s, which is not there", source, target)
        page = PAGES.get(path) or (path.startswith("docs/") and path.removeprefix("docs/"))
        return f"{mark}[{words}]({page}{anchor or ''})" if page else words

    parts = _CODE.split(text)
    parts[::2] = [_LINK.sub(link, part) for part in parts[::2]]
    return "".join(parts)


def on_files(files, config):
    """Add the pages from outside."""
    for source, page in PAGES.items():
        text = for_site((ROOT / source).read_text(encoding="utf-8"), source)
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown, page, **_):
    """The pages of docs/."""
    inside = page.file.src_uri not in PAGES.values()
    return for_site(markdown, f"docs/{page.file.src_uri}") if inside else markdown
