"""Every malformed option or file gets one line, the code of whose fault it is, and no trace."""

import os

import pytest

from planner_jax.cli.main import main
from tests.faults.bad_options import ROWS


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A working folder with something of every kind that a path may lead to."""
    folder = tmp_path_factory.mktemp("files")
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    (folder / "empty").touch()
    (folder / "junk").write_bytes(b"\xff\x00junk" * 100)
    return folder


def test_the_list_is_long():
    assert len(set(ROWS)) >= 300


@pytest.mark.parametrize(("arguments", "words"), ROWS, ids=lambda each: " ".join(each)[:60])
def test_it_is_refused_in_one_line_and_leaves_nothing(capsys, monkeypatch, files, arguments, words):
    monkeypatch.chdir(files)
    before = {name: os.lstat(name).st_mtime_ns for name in os.listdir()}
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    assert code in (1, 2), said
    assert said.out == ""
    assert said.err.startswith("planner-jax: error: ") and said.err.count("\n") == 1, said.err
    for word in words:
        assert word in said.err, said.err
    assert {name: os.lstat(name).st_mtime_ns for name in os.listdir()} == before
