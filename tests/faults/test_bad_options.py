"""Every malformed option or file is rejected with one line and exit code 2."""

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faults.bad_options import NUMBERS, ROWS, WHOLE, WORDS
from tests.faults.commands import is_one_line, run


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    (folder / "empty").touch()
    (folder / "junk").write_bytes(b"\xff\x00junk" * 100)
    before = os.getcwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


def refuse(arguments):
    before = {name: os.lstat(name).st_mtime_ns for name in os.listdir()}
    ended = run(*arguments)
    assert is_one_line(ended) and ended.code == 2, ended
    assert {name: os.lstat(name).st_mtime_ns for name in os.listdir()} == before
    return ended.err


@pytest.mark.parametrize(("arguments", "words"), ROWS, ids=lambda each: " ".join(each)[:60])
def test_it_is_refused_in_one_line_and_leaves_nothing(files, arguments, words):
    line = refuse(arguments)
    for word in words:
        assert word in line


def is_no(kind):
    def is_malformed(text):
        try:
            kind(text)
        except ValueError:
            return not text.startswith("-")
        return False

    return is_malformed


def spoil(options, texts):
    return st.tuples(st.sampled_from(options), texts)


TEXTS = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), max_size=20)
MALFORMED = st.one_of(
    spoil(WHOLE, st.one_of(TEXTS, st.just("1.5"), st.just("9" * 5000)).filter(is_no(int))),
    spoil(NUMBERS, st.one_of(TEXTS, st.just("1,5"), st.just("0x1p3")).filter(is_no(float))),
    spoil(WORDS, TEXTS.filter(lambda text: not text.isascii() and not text.startswith("-"))),
)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(MALFORMED)
def test_a_malformed_value_is_named_with_its_option(files, drawn):
    (command, option), value = drawn
    line = refuse([*command.split(), option, value])
    assert line.startswith(f"planner-jax: error: {option} must ") and ", got " in line
