"""Build the documentation site into build/site; `make docs` runs this.

All pages, also those from outside of docs/, are staged in build/pages with the links of the site. A
link to a file that is no page, such as a module, becomes plain text if the file exists. The build
fails for a broken link or anchor, and if a public name is missing from the API reference.
"""

import importlib.util
import inspect
import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STAGE, SITE = ROOT / "build" / "pages", ROOT / "build" / "site"
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "benchmarks/GPU_LOG.md": "gpu_log.md",
}
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
FIELD = re.compile(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", re.MULTILINE)  # a field and its text
CODE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def rewrite_links(text: str, source: str, problems: list[str]) -> str:
    """Return the text of a page with links that are relative to the page's place in the site.

    Links to files that are no pages become plain text. `source` is the path of the page in the
    repository; messages about links to missing files are appended to `problems`.
    """
    home = posixpath.dirname(PAGES.get(source) or source.removeprefix("docs/"))

    def rewrite(link: re.Match[str]) -> str:
        mark, words, target, anchor = link.groups()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if not (ROOT / path).exists():
            problems.append(f"{source} links to {target}, which does not exist")
        page = PAGES.get(path) or (path.startswith("docs/") and path.removeprefix("docs/"))
        if not page:
            return words
        return f"{mark}[{words}]({posixpath.relpath(page, home or '.')}{anchor or ''})"

    parts = CODE.split(text)
    parts[::2] = [LINK.sub(rewrite, part) for part in parts[::2]]
    return "".join(parts)


def stage_pages() -> list[str]:
    """Write all pages and pictures into build/pages, and return messages about faulty pages.

    A page is faulty if it links to a missing file, or if no menu in mkdocs.yml contains it.
    """
    problems: list[str] = []
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    shutil.rmtree(STAGE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", STAGE, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    pages = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / "docs").rglob("*.md")}
    for source in [*PAGES, *pages]:
        target = STAGE / (PAGES.get(source) or source.removeprefix("docs/"))
        text = (ROOT / source).read_text(encoding="utf-8")
        target.write_text(rewrite_links(text, source, problems), encoding="utf-8")
        if f": {target.relative_to(STAGE).as_posix()}\n" not in menu:
            problems.append(f"{source} is in no menu of mkdocs.yml")
    return problems


def public_names(package: str) -> list[str]:
    """Return the full names of the public functions and classes of a package.

    A function with the name of a submodule, such as `case`, is listed by the module that defines
    the function, because the function's name in the package would find the submodule.
    """
    module = importlib.import_module(package)
    names = []
    for name in module.__all__:
        value = getattr(module, name)
        if not inspect.ismodule(value):
            is_hidden = importlib.util.find_spec(f"{package}.{name}") is not None
            names.append(f"{value.__module__ if is_hidden else package}.{name}")
    return names


def inherited_fields(name: str) -> list[str]:
    """Return lines with the fields that a class inherits, each with its text; none for a function.

    The fields are stated in the sections "Attributes" of the docstrings of the bases.
    """
    package, _, own = name.rpartition(".")
    bases = getattr(getattr(importlib.import_module(package), own), "__mro__", ())[1:]
    texts = [inspect.cleandoc(base.__doc__ or "") for base in bases]
    sections = [text.partition("Attributes:\n")[2] for text in texts]
    fields = [FIELD.findall(section) for section in sections]
    lines = [f"- `{field}`: {' '.join(text.split())}" for own in fields for field, text in own]
    return ["Inherited fields:\n", *lines, ""] if lines else []


def write_api() -> None:
    """Add an entry for each public function and class to the API page, below its package."""
    page = STAGE / "api.md"
    lines = []
    for line in page.read_text(encoding="utf-8").splitlines():
        lines.append(line)
        if line.startswith("::: "):
            lines.append("    options:\n      members: false\n")
            for name in public_names(line.removeprefix("::: ")):
                lines.append(f"::: {name}\n    options:\n      show_root_heading: true")
                lines.append("      heading_level: 3\n      show_root_full_path: false\n")
                lines += inherited_fields(name)
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")


def missing_names() -> list[str]:
    """Return the public names that the built API reference lacks."""
    source = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    packages = re.findall(r"^::: (\S+)$", source, re.MULTILINE)
    page = (SITE / "api.html").read_text(encoding="utf-8")
    names = [name for package in packages for name in public_names(package)]
    return [name for name in names if f'id="{name}"' not in page]


def main() -> int:
    """Build and check the site, and return the exit code."""
    sys.path.insert(0, str(ROOT))
    problems = stage_pages()
    write_api()
    zensical = [str(Path(sys.executable).with_name("zensical")), "build", "--strict", "--clean"]
    if not problems and subprocess.run(zensical, cwd=ROOT, check=False).returncode:
        problems.append("zensical reports problems, see above")
    if not problems:
        problems += [f"the API reference lacks {name}" for name in missing_names()]
    print("\n".join(problems) or f"The site is {SITE / 'index.html'}")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
