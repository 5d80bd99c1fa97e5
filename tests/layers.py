"""Check that packages import only packages of lower layers, and make their table.

    python -m tests.layers [--write]

The program prints forbidden imports. With --write it first rewrites the table in CONTRIBUTING.md.
"""

import argparse
import ast
import dataclasses
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- packages: python -m tests.layers --write -->\n", "<!-- end of packages -->\n"
# Folders at the top of the repository that symbolic links make subpackages of `planner_jax`.
OUTSIDE = ("sims", "policies", "benchmarks")
# All packages. A module may import its own package, and packages that precede it in this list.
LAYERS = (
    *("host", "core", "lanes", "referee"),
    *("ball", "trajectory", "space", "robot", "plane"),
    *("cost", "penalties", "optimise", "perception", "planning", "recovery"),
    *("runs", "task", "baselines"),
    *("export", "sweep", "live", "__init__"),
    *("sims", "policies", "cli", "benchmarks", "__main__"),
)
# Package -> later packages whose modules it may name in strings, "planner_jax.module:Name". Such a
# module is imported only when a user selects it by name.
BY_NAME = {
    "cli": {"benchmarks"},
    "core": {"runs"},
    "robot": {"sims"},
    "task": {"baselines", "cli", "policies", "sims", "sweep"},
}
REGENERATE = "run `python -m tests.layers --write` and commit CONTRIBUTING.md"


@dataclasses.dataclass(frozen=True)
class Import:
    path: Path
    line: int
    name: str  # dotted, absolute
    is_string: bool = False
    is_lazy: bool = False  # inside a function

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}: {self.name}"

    @property
    def package(self) -> str | None:
        """The imported package of `planner_jax`, or None for a module outside `planner_jax`."""
        top, *parts = self.name.split(".")
        if top != "planner_jax":
            return top if top in OUTSIDE else None
        return parts[0] if parts and parts[0] in LAYERS else "__init__"


def list_modules() -> list[Path]:
    library = ROOT / "planner_jax"
    inside = [p for p in library.rglob("*.py*") if p.relative_to(library).parts[0] not in OUTSIDE]
    beside = [path for folder in OUTSIDE for path in (ROOT / folder).rglob("*.py*")]
    return sorted(path for path in inside + beside if path.suffix in (".py", ".pyi"))


def package_of(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return parts[0] if parts[0] in OUTSIDE else parts[1].split(".")[0]


def _names_of(statement: ast.AST, package: tuple[str, ...]) -> list[str]:
    """Return the absolute names that an import statement of a module in `package` imports."""
    if isinstance(statement, ast.Import):
        return [alias.name for alias in statement.names]
    if isinstance(statement, ast.ImportFrom):
        base = package[: len(package) - statement.level + 1] if statement.level else ()
        prefix = ".".join((*base, *filter(None, [statement.module])))
        return [f"{prefix}.{alias.name}" for alias in statement.names]
    return []


def read_imports(path: Path, source: str | None = None) -> Iterator[Import]:
    """Yield every import of a module, and every module of the library that a string names."""
    parts = path.relative_to(ROOT).parent.parts
    package = ("planner_jax", *parts) if parts[0] in OUTSIDE else parts
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)

    def visit(node: ast.AST, is_lazy: bool) -> Iterator[Import]:
        line = getattr(node, "lineno", 0)
        for name in _names_of(node, package):
            yield Import(path, line, name, is_lazy=is_lazy)
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if re.fullmatch(r"planner_jax(\.\w+)+(:\w+)?", node.value):
                yield Import(path, line, node.value.replace(":", "."), True, is_lazy)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, is_lazy or isinstance(node, functions))

    yield from visit(ast.parse(source or path.read_text()), False)


def is_allowed(found: Import) -> bool:
    own, other = package_of(found.path), found.package
    if own not in LAYERS:
        return False
    if other is None or other == own:
        return True
    if own == "cli" and other in OUTSIDE and not found.is_string:
        return found.is_lazy  # an installation may lack their dependencies
    is_below = LAYERS.index(other) < LAYERS.index(own)
    return is_below or (found.is_string and other in BY_NAME.get(own, ()))


def _purpose_of(package: str) -> str:
    folder = ROOT / package if package in OUTSIDE else ROOT / "planner_jax" / package
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    return (ast.get_docstring(ast.parse(file.read_text())) or "").split("\n")[0]


def make_table() -> str:
    """Return the Markdown table of packages: purpose, imports, packages named in strings."""
    imports = {package: set() for package in LAYERS}
    named = {package: set() for package in LAYERS}
    for found in (found for path in list_modules() for found in read_imports(path)):
        own, other = package_of(found.path), found.package
        if other not in (None, own):
            is_above = LAYERS.index(other) > LAYERS.index(own)
            (named if found.is_string and is_above else imports)[own].add(other)

    def join(packages: set[str]) -> str:
        return ", ".join(f"`{name}`" for name in LAYERS if name in packages)

    lines = ["| package | purpose | imports | names in strings |", "|---|---|---|---|"]
    for package in LAYERS:
        row = (_purpose_of(package), join(imports[package]) or "nothing", join(named[package]))
        lines.append(f"| `{package}` | {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def split_page() -> tuple[str, str, str]:
    """Split CONTRIBUTING.md into the text before the table, the table, and the text after it."""
    before, rest = PAGE.read_text().split(BEGIN)
    table, after = rest.split(END)
    return before + BEGIN, table, END + after


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="rewrite the table in CONTRIBUTING.md")
    if parser.parse_args().write:
        before, _, after = split_page()
        PAGE.write_text(before + make_table() + after)
    offenders = [f for path in list_modules() for f in read_imports(path) if not is_allowed(f)]
    sys.exit("\n".join(map(str, offenders)) or None)
