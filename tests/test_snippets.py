"""Python blocks and command lines of README and docs: they run, and they parse.

The blocks of a page run in one namespace. Before a block that cannot run is the comment
`<!-- not run: REASON -->`. A block `text` after a Python block is what the Python block prints.
"""

import contextlib
import io
import re
import shlex
import warnings
from pathlib import Path

import pytest

from planner_jax.cli.main import _make_parser

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BY_DEFAULT = ("README", "overview")  # the others compile programs of their own: slow
FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
NOT_RUN = re.compile(r"<!-- not run: .+ -->\s*$")
SMALL = {"draw(1000": "draw(16", "draw(100,": "draw(16,", "draw(100)": "draw(16)"}
# The README's own jit loop; docs/jit.md runs with the planners that it shows.
SMALL["pj.solve(pj.hit.planner()"] = 'pj.solve(pj.hit.planner("juggle")'
PLACEHOLDER = re.compile(r"[\[\]|{}*]|\.\.\.| [A-Z]\b")
COMMAND = re.compile(r"`((?:planner-jax|(?:taskset -c \d+ )?python -m benchmarks\.)[^`\n]*)`")


def python_blocks(page: Path) -> list[tuple[str, str | None]]:
    """Return the Python blocks of a page that run, each with the output on the page, or None."""
    text = page.read_text()
    blocks: list[tuple[str, str | None]] = []
    follows = False  # the last fence was a block that runs
    for fence in FENCE.finditer(text):
        language, source = fence[2], fence[3]
        if language == "text" and follows:
            blocks[-1] = (blocks[-1][0], source)
        follows = language == "python" and NOT_RUN.search(text[: fence.start()]) is None
        if follows:
            blocks.append((source, None))
    return blocks


def command_lines(page: Path) -> list[str]:
    """Return the command lines of a page that have no placeholders."""
    text = page.read_text()
    lines = [match[1] for match in COMMAND.finditer(FENCE.sub("", text))]
    for fence in FENCE.finditer(text):
        if fence[2] != "python" and NOT_RUN.search(text[: fence.start()]) is None:
            lines += [line.strip() for line in fence[3].replace("\\\n", " ").splitlines()]
    starts = ("planner-jax ", "python -m benchmarks.", "taskset ")
    return [line for line in lines if line.startswith(starts) and not PLACEHOLDER.search(line)]


def without_rounding(printed: str) -> str:
    return re.sub(r"\d\.?\d*e-\d\d", "TINY", printed)


WITH_PYTHON = [page for page in PAGES if python_blocks(page)]
WITH_COMMANDS = [page for page in PAGES if command_lines(page)]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=() if page.stem in BY_DEFAULT else pytest.mark.slow, id=page.stem)
        for page in WITH_PYTHON
    ],
)
def test_the_python_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "snippets"}
    for number, (source, expected) in enumerate(python_blocks(page)):
        for large, small in SMALL.items():
            source = source.replace(large, small)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(source, f"{page.name}, block {number}", "exec"), names)
        if expected is not None:
            assert without_rounding(printed.getvalue()) == without_rounding(expected)


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.stem)
def test_the_command_lines_of_a_page_parse(page):
    for line in command_lines(page):
        words = shlex.split(line.partition(" > ")[0], comments=True)
        if words[0] == "planner-jax":
            only_named = all(word.isalpha() and word.islower() for word in words[1:])
            parse(line, [*words[1:], "--help"] if only_named else words[1:])
        else:
            find_options_of_benchmark(line, words)


def parse(line: str, words: list[str]) -> None:
    """Fail unless the command line's parser accepts some words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            _make_parser().parse_args(words)
        except SystemExit as stop:
            assert stop.code == 0, line
        except Exception as error:
            raise AssertionError(f"{line}: {error}") from error


def find_options_of_benchmark(line: str, words: list[str]) -> None:
    """Fail unless a benchmark's module exists and names the options of a command line."""
    module = words[words.index("-m") + 1].removeprefix("benchmarks.")
    path = ROOT / "benchmarks" / f"{module}.py"
    assert path.exists(), line
    source = path.read_text()
    for word in words:
        if word.startswith("--"):
            name = word[2:].replace("-", "_") + "="  # as `argument_parser` takes it
            assert word in source or name in source, f"{line}: {word}"
