"""Parquet files joined by copying their pages as they are, behind one footer.

A Parquet file is its pages, behind a magic word, and a footer, which says where they lie: the
struct FileMetaData of `parquet.thrift`, in Thrift's compact protocol. To join files their footers
are taken apart as far as places in the file stand in them. What else stands there is copied, known
or not; what would be wrong in another place is refused.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import pyarrow as pa

_MAGIC = b"PAR1"
_ENDING = 8  # bytes behind a footer: its length, and the magic word
_BYTE, _SHORT, _LONG, _BINARY, _LIST, _SET, _MAP, _STRUCT = 3, 4, 6, 8, 9, 10, 11, 12
_SIZES = {1: 0, 2: 0, _BYTE: 1, 7: 8, 13: 16}  # bytes of a value, by its kind; 1, 2: true, false
_MOST_GROUPS = 2**15  # whose place among the others fits into their short field of it
_BLOCK = 1 << 20  # bytes that are written at once
_MOST_BITS = 63  # of a number, without its sign

# Fields by number. Of the file:
_ROWS, _GROUPS, _METADATA = 3, 4, 5
# Of a row group; where it begins, and which it is among the others.
_COLUMNS, _GROUP_ROWS, _GROUP_START, _ORDINAL = 1, 3, 5, 7
# Of a column of a row group; its file_offset, a place that is 0 where it is left out.
_COLUMN_START, _COLUMN = 2, 3
_REFUSED = {
    1: "pages in another file",
    4: "an index of its pages",  # which holds places in the file, too
    6: "an index of its pages",
    8: "encrypted columns",
    9: "encrypted columns",
}
# Of what is known of its pages: their bytes; where pages of data, an index, a dictionary and a
# Bloom filter are.
_PAGES_SIZE, _DATA, _DICTIONARY = 7, 9, 11
_PLACES = (_DATA, 10, _DICTIONARY, 14)


class JoinError(ValueError):
    """A file is none that can be joined; a few words that say why."""


@dataclasses.dataclass(frozen=True)
class _Field:
    """A field of a struct, and of its value the bytes around places in the file."""

    number: int
    kind: int
    pieces: tuple[bytes, ...]  # one more than there are places
    places: tuple[int, ...] = ()

    def moved(self, by: int) -> bytes:
        """Its value in a file where all is so many bytes further on; what is at 0 is nowhere."""
        values = [_signed(place + by if place else 0) for place in self.places]
        pairs = itertools.zip_longest(self.pieces, values, fillvalue=b"")
        return b"".join(itertools.chain.from_iterable(pairs))


@dataclasses.dataclass(frozen=True)
class ParquetParts:
    """A Parquet file, taken apart."""

    pages: Any  # the bytes before its footer, the magic word among them
    num_rows: int
    metadata: dict[bytes, bytes]
    _fields: list[_Field]  # of the footer, but for those of the above, and for row groups
    _groups: list[list[_Field]]  # their ordinals, where they have some, are those in this file

    def ending(self, metadata: Mapping[bytes, bytes]) -> bytes:
        """What follows the pages in a file with these metadata: the footer, and its end."""
        groups = self._groups_at(0, 0)
        return _ending(self._fields, self.num_rows, len(self._groups), groups, metadata)

    def without(self, key: bytes) -> "ParquetParts":
        """The same, without an entry of the metadata."""
        kept = {name: value for name, value in self.metadata.items() if name != key}
        return dataclasses.replace(self, metadata=kept)

    def _groups_at(self, first: int, by: int) -> bytes:
        """The row groups where so many others and so many bytes more are before them."""
        found = []
        for ordinal, group in enumerate(self._groups, first):
            fields = []
            for field in group:
                if field.number != _ORDINAL:
                    fields.append(_Field(field.number, field.kind, (field.moved(by),)))
                elif ordinal < _MOST_GROUPS:
                    fields.append(_Field(_ORDINAL, _SHORT, (_signed(ordinal),)))
            found.append(_struct(fields))
        return b"".join(found)


class ParquetJoiner:
    """Writes one Parquet file from others of the same columns and metadata.

    Args:
        file: that is written; it is whole once `end` was called.
    """

    def __init__(self, file: BinaryIO):
        self._file, self._first, self._place = file, None, len(_MAGIC)
        self._groups, self._num_groups, self._num_rows = bytearray(), 0, 0
        file.write(_MAGIC)

    def add(self, parts: ParquetParts) -> None:
        """Copy the pages of a file behind those that are there.

        Raises:
            JoinError: the file has other columns or metadata than the first one.
        """
        if self._first is None:
            self._first = dataclasses.replace(parts, pages=b"", _groups=[])
        first = self._first
        if parts._fields != first._fields or parts.metadata != first.metadata:
            raise JoinError("has other columns or metadata than the files before it")
        by = self._place - len(_MAGIC)
        self._groups += parts._groups_at(self._num_groups, by)
        self._num_groups += len(parts._groups)
        self._num_rows += parts.num_rows
        pages = memoryview(parts.pages)[len(_MAGIC) :]
        write_in_blocks(self._file, pages)
        self._place += len(pages)

    def end(self) -> None:
        """Write the footer.

        Raises:
            JoinError: there were no files.
        """
        if self._first is None:
            raise JoinError("is made of no files, and so has no columns")
        of_file = self._first._fields, self._num_rows, self._num_groups
        self._file.write(_ending(*of_file, self._groups, self._first.metadata))


def parquet_parts(content: Any) -> ParquetParts:
    """Take a Parquet file apart.

    Args:
        content: its bytes, or a buffer of them, of which the pages remain a part.

    Raises:
        JoinError: it is none, or has what cannot be copied: page indexes, pages in other files,
            encrypted columns.
    """
    buffer = pa.py_buffer(content)
    ending = bytes(buffer[max(buffer.size - _ENDING, 0) :])
    length = int.from_bytes(ending[:4], "little")
    start = buffer.size - _ENDING - length
    if ending[4:] != _MAGIC or bytes(buffer[:4]) != _MAGIC or start < len(_MAGIC):
        raise JoinError("is not Parquet")
    try:
        return _read(buffer[:start], bytes(buffer[start : start + length]))
    except (IndexError, KeyError, RecursionError, UnicodeDecodeError):
        raise JoinError("has a footer that is not one of Parquet") from None


def _read(pages: pa.Buffer, footer: bytes) -> ParquetParts:
    reader = _Reader(footer)
    kept, groups, metadata, num_rows = [], [], {}, -1
    for number, kind in reader.fields():
        if number == _ROWS:
            num_rows = reader.number(kind)
        elif number == _GROUPS:
            groups = [_group(reader, pages.size) for _ in range(reader.length(kind, _STRUCT))]
        elif number == _METADATA:
            for _ in range(reader.length(kind, _STRUCT)):
                key, value = _entry(reader)
                metadata[key] = value
        else:
            kept.append(_Field(number, kind, (reader.skipped(kind),)))
    if reader.place != len(footer):
        raise JoinError("has a footer with something behind it")
    if num_rows != sum(rows for rows, _ in groups):
        raise JoinError("has a footer whose numbers of rows do not agree")
    return ParquetParts(pages, num_rows, metadata, kept, [fields for _, fields in groups])


def _group(reader: "_Reader", end: int) -> tuple[int, list[_Field]]:
    """The number of rows of a row group, and its fields."""
    fields, rows, columns = [], -1, False
    for number, kind in reader.fields():
        start = reader.place
        if number == _COLUMNS:
            places = _Places(reader, end)
            for _ in range(reader.length(kind, _STRUCT)):
                _column(reader, places)
            fields.append(places.field(number, kind, start))
            columns = True
        elif number == _GROUP_START:
            places = _Places(reader, end)
            places.take(kind)
            fields.append(places.field(number, kind, start))
        else:
            if number == _GROUP_ROWS:
                rows = reader.number(kind)
            else:
                reader.skip(kind)
            fields.append(_Field(number, kind, (reader.data[start : reader.place],)))
    if not columns or rows < 0:
        raise JoinError("has row groups without columns or rows")
    return rows, fields


def _column(reader: "_Reader", places: "_Places") -> None:
    """Go past a column of a row group."""
    known = False
    for number, kind in reader.fields():
        if number in _REFUSED:
            raise JoinError(f"has {_REFUSED[number]}, which cannot be copied")
        if number == _COLUMN_START:
            places.take(kind)
        elif number == _COLUMN and kind == _STRUCT:
            _pages(reader, places)
            known = True
        else:
            reader.skip(kind)
    if not known:
        raise JoinError("has columns that do not say where their pages are")


def _pages(reader: "_Reader", places: "_Places") -> None:
    """Go past what is known of the pages of a column."""
    size, found = -1, {}
    for number, kind in reader.fields():
        if number in _PLACES:
            found[number] = places.take(kind)
        elif number == _PAGES_SIZE:
            size = reader.number(kind)
        else:
            reader.skip(kind)
    start = min(found.get(_DICTIONARY) or found.get(_DATA, 0), found.get(_DATA, 0))
    if size < 0 or start < len(_MAGIC) or start + size > places.end:
        raise JoinError("has columns whose pages are not before its footer")


def _entry(reader: "_Reader") -> tuple[bytes, bytes]:
    """Key and value of the metadata."""
    found = {number: reader.binary(kind) for number, kind in reader.fields()}
    return found[1], found[2]


class _Places:
    """The places in the file that a reader finds in a value."""

    def __init__(self, reader: "_Reader", end: int):
        self.end = end  # of the pages
        self._reader = reader
        self._found: list[tuple[int, int, int]] = []  # begin and end of the bytes, and the place

    def take(self, kind: int) -> int:
        """Read a place."""
        start = self._reader.place
        place = self._reader.number(kind)
        if not 0 <= place < self.end:
            raise JoinError("has pages that are not before its footer")
        self._found.append((start, self._reader.place, place))
        return place

    def field(self, number: int, kind: int, start: int) -> _Field:
        """The field whose value began there and has just been read."""
        pieces = []
        for begin, end, _ in self._found:
            pieces.append(self._reader.data[start:begin])
            start = end
        pieces.append(self._reader.data[start : self._reader.place])
        return _Field(number, kind, tuple(pieces), tuple(place for *_, place in self._found))


class _Reader:
    """Reads Thrift's compact protocol; an IndexError where it ends too early."""

    def __init__(self, data: bytes, place: int = 0):
        self.data, self.place = data, place

    def unsigned(self) -> int:
        """A number in groups of seven bits."""
        value = self.data[self.place]
        self.place += 1
        if value < 0x80:
            return value
        value &= 0x7F
        for shift in range(7, _MOST_BITS + 1, 7):
            byte = self.data[self.place]
            self.place += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise IndexError

    def number(self, kind: int) -> int:
        """A number with a sign."""
        if not _SHORT <= kind <= _LONG:
            raise IndexError
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def binary(self, kind: int) -> bytes:
        """Bytes of a length that stands before them."""
        if kind != _BINARY:
            raise IndexError
        start = self.unsigned() + self.place
        start, self.place = self.place, start
        if self.place > len(self.data):
            raise IndexError
        return self.data[start : self.place]

    def length(self, kind: int, of: int) -> int:
        """The length of a list of values of a kind."""
        found, each = self.head()
        if kind != _LIST or each != of:
            raise IndexError
        return found

    def head(self) -> tuple[int, int]:
        """Length of a list, and kind of its values."""
        head = self.data[self.place]
        self.place += 1
        length = head >> 4
        return self.unsigned() if length == 15 else length, head & 0x0F

    def fields(self) -> Iterator[tuple[int, int]]:
        """Numbers and kinds of a struct's fields; who is given one reads its value."""
        number = 0
        while head := self.data[self.place]:
            self.place += 1
            number = number + (head >> 4) if head >> 4 else self.number(_SHORT)
            yield number, head & 0x0F
        self.place += 1

    def skipped(self, kind: int) -> bytes:
        """A value as it is."""
        start = self.place
        self.skip(kind)
        return self.data[start : self.place]

    def skip(self, kind: int) -> None:
        """Go past a value."""
        self.place = _behind(self.data, self.place, kind)
        if self.place > len(self.data):
            raise IndexError


def _behind(data: bytes, place: int, kind: int) -> int:
    """The place behind a value; it may be beyond the end of the data."""
    if _SHORT <= kind <= _LONG:
        while data[place] > 0x7F:
            place += 1
        return place + 1
    if kind == _STRUCT:
        while head := data[place]:
            place += 1
            if head < 0x10:
                place = _behind(data, place, _SHORT)
            place = _behind(data, place, head & 0x0F)
        return place + 1
    if kind == _BINARY:
        reader = _Reader(data, place)
        length = reader.unsigned()
        return reader.place + length
    if kind in (_LIST, _SET):
        reader = _Reader(data, place)
        length, each = reader.head()
        place = reader.place
        for _ in range(length):
            place = _behind(data, place, _BYTE if each in (1, 2) else each)
        return place
    return place + _SIZES[kind]


def _unsigned(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)


def _signed(value: int) -> bytes:
    return _unsigned(value << 1 if value >= 0 else (-value << 1) - 1)


def _struct(fields: list[_Field]) -> bytes:
    """A struct of fields in the order of their numbers, without places."""
    found, last = [], 0
    for field in fields:
        step = field.number - last
        if 0 < step < 16:
            found.append(bytes([step << 4 | field.kind]))
        else:
            found.append(bytes([field.kind]) + _signed(field.number))
        found += field.pieces
        last = field.number
    return b"".join([*found, b"\0"])


def _list(length: int, items: bytes | bytearray) -> bytes:
    """A list of structs."""
    short, rest = (length, b"") if length < 15 else (15, _unsigned(length))
    return bytes([short << 4 | _STRUCT]) + rest + items


def write_in_blocks(file: BinaryIO, content: Any) -> None:
    """Write bytes or a buffer, a block at a time: ext4 takes 100 MB at once far more slowly."""
    view = memoryview(content)
    for start in range(0, len(view), _BLOCK):
        file.write(view[start : start + _BLOCK])


def _ending(
    fields: list[_Field],
    num_rows: int,
    num_groups: int,
    groups: bytes | bytearray,
    metadata: Mapping[bytes, bytes],
) -> bytes:
    """A footer, its length and the magic word."""
    entries = [
        _struct([_Field(n, _BINARY, (_unsigned(len(x)), x)) for n, x in enumerate(entry, 1)])
        for entry in metadata.items()
    ]
    whole = [
        *fields,
        _Field(_ROWS, _LONG, (_signed(num_rows),)),
        _Field(_GROUPS, _LIST, (_list(num_groups, groups),)),
        _Field(_METADATA, _LIST, (_list(len(entries), b"".join(entries)),)),
    ]
    footer = _struct(sorted(whole, key=lambda field: field.number))
    return footer + len(footer).to_bytes(4, "little") + _MAGIC
