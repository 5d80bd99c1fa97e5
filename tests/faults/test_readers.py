"""Damaged files are refused in one line, mended, or read as if they were whole."""

import json
import os
import uuid
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planner_jax.runs.parts import Parts
from planner_jax.runs.plain_json import read_object
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SettingError
from planner_jax.sweep.run import resume_sweep
from tests.faults.commands import is_one_line, run
from tests.faults.runs import TARGETS, TASK, copied, rows_of, verdict


@pytest.mark.parametrize("what", TARGETS)
@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(random=st.randoms(use_true_random=False), choice=st.integers(0, 7))
def test_damage_is_refused_in_one_line_or_mended_or_changes_nothing(runs, what, random, choice):
    targets = TARGETS[what]
    target, name = targets[choice % len(targets)]
    verdict(runs, target, name, random, runs / uuid.uuid4().hex)


def rewritten(out, **entries):
    """The manifest with other entries, as if it had been written so."""
    folder = RunFolder(out)
    folder.write_manifest({**read_object(out / "manifest.json"), **entries})


@pytest.mark.parametrize(
    ("found", "told"),
    [(2, "got format 2 in"), (0, "got format 0 in"), (None, "got one without a format in")],
)
def test_another_format_is_named_beside_the_one_that_is_understood(runs, tmp_path, found, told):
    out = copied(runs, "whole", tmp_path)
    manifest = {**read_object(out / "manifest.json"), "format": found}
    (out / "manifest.json").write_text(json.dumps(manifest))
    ended = run("report", out)
    assert is_one_line(ended) and "RUN must be a run of format 1" in ended.err and told in ended.err


def test_an_edited_manifest_is_refused(runs, tmp_path):
    out = copied(runs, "begun", tmp_path)
    text = (out / "manifest.json").read_text()
    (out / "manifest.json").write_text(text.replace('"batch": 13', '"batch": 7'))
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert is_one_line(ended) and "manifest.json is whole" in ended.err and "edited" in ended.err


def test_a_summary_that_its_rows_do_not_have_is_refused(runs, tmp_path):
    out = copied(runs, "whole", tmp_path)
    summary = read_object(out / "manifest.json")["summary"]
    rewritten(out, summary={**summary, "successes": summary["successes"] - 1})
    ended = run("report", out)
    assert is_one_line(ended) and "RUN must be a run whose successes is that of its" in ended.err


def test_a_run_is_not_gone_on_with_by_other_versions_code_or_devices(runs, tmp_path):
    out = copied(runs, "begun", tmp_path)
    manifest = read_object(out / "manifest.json")
    for entry, value, told in (
        ("versions", {**manifest["versions"], "jax": "0.0.1"}, "jax 0.0.1, as it began, got 0."),
        ("device", {**manifest["device"], "kind": "abacus"}, "devices of kind abacus, as it"),
        ("device", {**manifest["device"], "processor": "Z80"}, "processor Z80, as it began, got "),
        ("device", {**manifest["device"], "threads": 99}, r"\(NPROC\) 99, as it began, got "),
        ("code", "0" * 64, r"planner-jax of commit .* \(files 000000000000\), as it began, got"),
    ):
        rewritten(out, **{**manifest, entry: value})
        with pytest.raises(SettingError, match=told):
            resume_sweep(TASK, out, progress=False)


@pytest.mark.parametrize("entry", ["run", "version"])
def test_parts_of_another_run_or_version_are_planned_again(runs, tmp_path, entry):
    out = copied(runs, "begun", tmp_path)
    rewritten(out, **{entry: "another"})
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and ended.err.count(f"is of {entry} ") == 3
    assert rows_of(out) == rows_of(runs / "whole")


def test_a_part_in_the_place_of_another_is_planned_again(runs, tmp_path):
    out = copied(runs, "begun", tmp_path)
    first, *_ = sorted((out / "parts").iterdir())
    first.rename(first.with_name(first.name.replace("000000", "000003")))
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and "is of first 0, and not of 39" in ended.err
    assert rows_of(out) == rows_of(runs / "whole")


def test_a_part_that_is_damaged_once_it_was_found_sound_is_not_joined(runs, tmp_path, monkeypatch):
    out, real = copied(runs, "begun", tmp_path), Parts.sound

    def sound(self):
        found = real(self)
        path = found[1].path
        content = bytearray(path.read_bytes())
        content[100] ^= 1
        path.write_bytes(content)
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Parts, "sound", sound)
        ended = run("sweep", "hit", "--resume", "--out", out)
    last = ended.err.splitlines()[-1]
    assert ended.code == 1 and f"{out}/parts/part-000001-" in last and "damaged while" in last
    assert not (out / "plans.parquet").exists()
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and "is damaged: its checksum is not that of its name" in ended.err
    assert rows_of(out) == rows_of(runs / "whole")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1\x19\x0c\0\3\0\0\0PAR1"])
def test_a_part_whose_name_fits_and_whose_footer_does_not_is_planned_again(runs, tmp_path, content):
    out = copied(runs, "begun", tmp_path)
    path = sorted((out / "parts").iterdir())[0]
    path.unlink()
    path.with_name(f"part-000000-{zlib.crc32(content):08x}.parquet").write_bytes(content)
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and ended.err.count("planned again") == 1
    assert rows_of(out) == rows_of(runs / "whole")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
@pytest.mark.parametrize(
    ("run_of", "name", "command"),
    [
        ("begun", "manifest.json", ("sweep", "hit", "--resume", "--out")),
        ("begun", "parts/part-*.parquet", ("sweep", "hit", "--resume", "--out")),
        ("whole", "manifest.json", ("report",)),
        ("whole", "plans.parquet", ("report",)),
        ("flights", "flights.parquet", ("view",)),
        ("flights", "manifest.json", ("view",)),
    ],
)
def test_what_is_no_plain_file_is_refused_without_waiting(
    runs, tmp_path, kind, run_of, name, command
):
    out = copied(runs, run_of, tmp_path)
    path = sorted(out.glob(name))[0]
    path.unlink()
    if kind == "device":
        path.symlink_to("/dev/zero")
    else:
        (os.mkfifo if kind == "pipe" else os.mkdir)(path)
    kept = sorted(out.rglob("*"))
    ended = run(*command, out)
    assert is_one_line(ended) and ended.code == 2, ended
    assert sorted(out.rglob("*")) == kept


def test_a_folder_with_a_pipe_in_the_place_of_the_lock_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / ".lock")
    RunFolder(tmp_path).require_new()


def test_parts_are_looked_for_where_they_are_and_never_beyond_the_run(runs, tmp_path):
    out = copied(runs, "begun", tmp_path)
    part = sorted((out / "parts").iterdir())[0]
    names = ("part-999999-00000000.parquet", f"part-{'9' * 200}-00000000.parquet")
    for name in (*names, f"part-0-{part.stem.rpartition('-')[2]}.parquet"):
        (out / "parts" / name).write_bytes(part.read_bytes())
    ended = run("sweep", "hit", "--resume", "--out", out)
    assert ended.code == 0 and ended.err.count("planned again") == 3
    assert "is beyond the 4 parts of the run" in ended.err and "is there twice" in ended.err
    assert (out / "plans.parquet").read_bytes() == (runs / "whole" / "plans.parquet").read_bytes()
