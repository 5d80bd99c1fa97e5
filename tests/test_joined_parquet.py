"""Parquet files joined by their pages: rows, places, what is kept, and what is refused."""

import dataclasses
import inspect
import io
import pickle
import random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner_jax.runs import joined_parquet
from planner_jax.runs.columns import LIST, VECTOR
from planner_jax.runs.joined_parquet import JoinError, ParquetJoiner, parquet_parts
from planner_jax.runs.parquet import (
    ROW_GROUP,
    encoded,
    file_sum,
    opened,
    pick_rows,
    read_rows,
    row_groups,
)
from tests.faults.damage import ANY

SCHEMA = pa.schema(
    [
        pa.field("index", pa.int64(), metadata={"unit": ""}),
        pa.field("status", pa.string()),
        pa.field("success", pa.bool_()),
        pa.field("cost", pa.float32(), metadata={"unit": "1", "meaning": "what it costs"}),
        pa.field("velocity", VECTOR),
        pa.field("times", LIST),
        pa.field("published", pa.bool_()),
    ],
    metadata={"frame": "world", "kept": "as it is"},
)


def table(num, first=0, texts=("CONVERGED", "INFEASIBLE", "")):
    """Some rows: text that repeats, nulls, lists of equal and of other lengths, some empty."""
    index = np.arange(first, first + num)
    values = np.random.default_rng(first).normal(size=(num, 4)).astype(np.float32)
    arrays = {
        "index": index,
        "status": [texts[k % len(texts)] for k in index],
        "success": index % 3 == 0,
        "cost": [
            None if k % 5 == 0 else float(v) for k, v in zip(index, values[:, 0], strict=True)
        ],
        "velocity": list(values[:, 1:]),
        "times": [values[k, : (first + k) % 4] for k in range(num)],
        "published": [None] * num,
    }
    return pa.table(arrays, schema=SCHEMA)


def joined(contents):
    """The content of the file that is joined from others."""
    file = io.BytesIO()
    joiner = ParquetJoiner(file)
    for content in contents:
        joiner.add(parquet_parts(content))
    joiner.end()
    return file.getvalue()


def read(content):
    with opened(pa.BufferReader(content)) as file:
        return file.read()


def with_footer(content, change):
    """A file whose footer is changed as bytes."""
    length = int.from_bytes(content[-8:-4], "little")
    footer = change(content[-8 - length : -8])
    return content[: -8 - length] + footer + len(footer).to_bytes(4, "little") + b"PAR1"


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.sampled_from([1, 2, 7, ROW_GROUP - 1, ROW_GROUP, 2 * ROW_GROUP + 3]), min_size=1)
)
def test_rows_schema_and_metadata_are_those_of_the_tables_put_together(sizes):
    starts = np.cumsum([0, *sizes])
    tables = [table(num, int(first)) for num, first in zip(sizes, starts, strict=False)]
    content = joined(map(encoded, tables))
    found, wanted = read(content), pa.concat_tables(tables)
    assert found.equals(wanted) and found.schema.equals(SCHEMA, check_metadata=True)
    one = encoded(wanted)
    with opened(pa.BufferReader(content)) as file, opened(pa.BufferReader(one)) as plain:
        assert file.metadata.num_rows == sum(sizes)
        assert file.metadata.metadata == plain.metadata.metadata
        assert file.metadata.created_by == plain.metadata.created_by
        assert file.schema.equals(plain.schema)
        assert file.metadata.num_row_groups == sum(-(-num // ROW_GROUP) for num in sizes)


def test_whole_row_groups_are_joined_to_the_bytes_that_arrow_writes_at_once():
    parts = [table(2 * ROW_GROUP), table(ROW_GROUP, 2 * ROW_GROUP), table(5, 3 * ROW_GROUP)]
    assert joined(map(encoded, parts)) == encoded(pa.concat_tables(parts))


def test_one_file_is_joined_to_its_own_bytes():
    content = encoded(table(ROW_GROUP + 1))
    assert joined([content]) == content


def test_joined_files_can_be_joined():
    parts = [encoded(table(9, first)) for first in (0, 9, 18)]
    assert joined([joined(parts[:2]), parts[2]]) == joined(parts)


@pytest.mark.parametrize("texts", [("",), ("ä" * 300,), tuple(map(str, range(5000)))])
def test_text_keeps_the_dictionaries_of_its_own_part(texts):
    parts = [table(3000, 0, texts), table(10, 3000, texts[::-1])]
    assert read(joined(map(encoded, parts))).equals(pa.concat_tables(parts))


def test_rows_of_uneven_groups_are_found(tmp_path):
    sizes = (3, ROW_GROUP + 5, 1)
    starts = np.cumsum([0, *sizes])
    path = tmp_path / "plans.parquet"
    path.write_bytes(joined(encoded(table(n, int(s))) for n, s in zip(sizes, starts, strict=False)))
    wanted = [0, 2, 3, 4, ROW_GROUP + 2, ROW_GROUP + 3, ROW_GROUP + 7, ROW_GROUP + 8]
    assert [row["index"] for row in pick_rows(path, wanted)] == wanted
    firsts = [(first, rows["index"][0].as_py()) for first, rows in row_groups(path)]
    assert firsts == [(k, k) for k in (0, 3, ROW_GROUP + 3, ROW_GROUP + 8)]
    assert read_rows(path, ["cost"]).num_rows == sum(sizes)
    assert file_sum(path)["bytes"] == path.stat().st_size


def test_a_bit_that_flips_in_a_page_of_any_part_is_found():
    content = joined(encoded(table(500, first)) for first in (0, 500))
    metadata = pq.read_metadata(pa.BufferReader(content))
    for group in range(metadata.num_row_groups):
        for column in range(metadata.num_columns):
            known = metadata.row_group(group).column(column)
            last = known.data_page_offset + known.total_compressed_size - 1
            if known.has_dictionary_page:
                last = known.dictionary_page_offset + known.total_compressed_size - 1
            damaged = bytearray(content)
            damaged[last] ^= 1
            with pytest.raises((OSError, pa.ArrowException)):
                read(bytes(damaged))


def test_statistics_and_places_are_those_of_the_rows():
    content = joined(encoded(table(num, first)) for num, first in ((4, 0), (6, 4)))
    metadata = pq.read_metadata(pa.BufferReader(content))
    found = [metadata.row_group(k).column(0).statistics for k in range(2)]
    assert [(each.min, each.max, each.null_count) for each in found] == [(0, 3, 0), (4, 9, 0)]
    assert metadata.row_group(1).column(1).dictionary_page_offset > len(encoded(table(4))) // 4


def test_a_footer_is_written_as_it_was_read_and_with_other_metadata():
    content = encoded(table(ROW_GROUP + 1))
    parts = parquet_parts(content)
    assert bytes(parts.pages) + parts.ending(parts.metadata) == content
    assert parts.num_rows == ROW_GROUP + 1
    with_more = bytes(parts.pages) + parts.ending({**parts.metadata, b"part": b"{}"})
    assert pq.read_metadata(pa.BufferReader(with_more)).metadata[b"part"] == b"{}"
    assert joined([with_more]) != content
    again = parquet_parts(with_more).without(b"part")
    assert bytes(again.pages) + again.ending(again.metadata) == content


def test_what_is_sent_to_another_process_is_the_same_and_its_pages_are_not_copied():
    parts, buffers = parquet_parts(encoded(table(3000))), []
    told = pickle.dumps(parts, protocol=5, buffer_callback=buffers.append)
    assert pickle.loads(told, buffers=buffers) == parts
    assert len(told) < 20_000 and buffers[0].raw().nbytes == parts.pages.size


def numbered(content, last=2**15 + 7):
    """A file whose row groups have ordinals, and a field that no reader knows, far behind them."""
    field = joined_parquet._Field
    more = [field(7, 4, (joined_parquet._signed(0),)), field(40, 8, (b"\3new",))]
    parts = parquet_parts(content)
    # Some versions of pyarrow write ordinals themselves.
    groups = [[*(each for each in group if each.number != 7), *more] for group in parts._groups]
    changed = dataclasses.replace(parts, _groups=groups)
    return bytes(changed.pages) + changed.ending(changed.metadata)


def test_ordinals_are_counted_on_and_left_out_where_they_do_not_fit(monkeypatch):
    monkeypatch.setattr(joined_parquet, "_MOST_GROUPS", 3)
    parts = [numbered(encoded(table(num, 0))) for num in (2 * ROW_GROUP, ROW_GROUP + 1, 5)]
    content = joined(parts)
    groups = parquet_parts(content)._groups
    ordinals = [[f.pieces[0] for f in group if f.number == 7] for group in groups]
    assert ordinals == [[b"\0"], [b"\2"], [b"\4"], [], []]
    assert all(group[-1].number == 40 and group[-1].pieces == (b"\3new",) for group in groups)
    assert len(read(content)) == 3 * ROW_GROUP + 6


def test_as_many_groups_as_have_no_ordinal_any_more_are_read():
    first, content = numbered(encoded(table(1))), encoded(table(1))
    file, number = io.BytesIO(), 2**15 + 2
    joiner, parts = ParquetJoiner(file), parquet_parts(first)
    for _ in range(number):
        joiner.add(parts)
    joiner.end()
    with opened(pa.BufferReader(file.getvalue())) as joined_file:
        assert joined_file.num_row_groups == number == joined_file.metadata.num_rows
        assert joined_file.read_row_group(number - 1).equals(read(content))


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"write_page_index": True}, "an index of its pages"),
        ({"row_group_size": 2}, None),
        ({"use_dictionary": False, "compression": "zstd", "data_page_version": "2.0"}, None),
        pytest.param(
            {"bloom_filter_options": {"status": {}}},
            None,
            marks=pytest.mark.skipif(
                "bloom_filter_options" not in inspect.signature(pq.write_table).parameters,
                reason="this pyarrow writes no Bloom filters",
            ),
        ),
    ],
)
def test_files_of_other_writers_are_joined_or_refused(options, why):
    file = io.BytesIO()
    pq.write_table(table(8), file, **options)
    if why is None:
        assert read(joined([file.getvalue()] * 2)).equals(pa.concat_tables([table(8)] * 2))
    else:
        with pytest.raises(JoinError, match=why):
            parquet_parts(file.getvalue())


@pytest.mark.parametrize(
    "other",
    [
        table(4).select(["index", "status"]),
        table(4).replace_schema_metadata({"frame": "body"}),
        table(4).rename_columns([*SCHEMA.names[:-1], "another"]),
    ],
)
def test_a_file_of_other_columns_or_metadata_is_refused(other):
    with pytest.raises(JoinError, match="has other columns or metadata"):
        joined([encoded(table(4)), encoded(other)])


def test_no_files_are_no_file():
    with pytest.raises(JoinError, match="of no files"):
        joined([])


CONTENT = encoded(table(40))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is not Parquet"),
        (b"PAR1", "is not Parquet"),
        (b"PAR1\0\0\0\0PAR1", "not one of Parquet"),
        (CONTENT[:-1], "is not Parquet"),
        (CONTENT[:-8] + b"\xff\xff\xff\x7fPAR1", "is not Parquet"),
        (CONTENT[:-4] + b"PARE", "is not Parquet"),
        (b"X" + CONTENT[1:], "is not Parquet"),
        (CONTENT[:4] + CONTENT[400:], "pages are not before its footer|are not before its"),
        (with_footer(CONTENT, lambda footer: footer + b"\0"), "something behind it"),
        (with_footer(CONTENT, lambda footer: footer[:-1]), "not one of Parquet"),
        (with_footer(CONTENT, lambda footer: b"\x1c" * 5000), "not one of Parquet"),
        (with_footer(CONTENT, lambda _: b"\x36\x04\0"), "rows do not agree"),
    ],
)
def test_a_malformed_file_is_refused_in_few_words(content, why):
    with pytest.raises(JoinError, match=why):
        parquet_parts(content)


def test_a_damaged_footer_is_refused_in_few_words_or_can_be_written_again():
    source = random.Random(0)
    length = len(CONTENT)
    for _ in range(1500):
        damaged = with_footer(CONTENT, lambda footer: source.choice(ANY)(footer, source))
        try:
            parts = parquet_parts(damaged)
        except JoinError:
            continue
        assert parts.pages.size < length and parts.num_rows >= 0
        parts.ending(parts.metadata)
