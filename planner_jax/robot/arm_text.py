"""The text of an arm's file, MJCF or URDF, and of all files that MuJoCo's compiler reads with it.

The texts are checked before the compiler reads them. A file of a hundred bytes could otherwise make
the compiler open a pipe, which blocks, or fill the memory.
"""

import math
import os
import re
from pathlib import Path
from xml.parsers import expat

from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import open_plain, read_plain
from planner_jax.robot.capsule_fit import LARGEST_MESH

_TEXTS, _FILES = 1 << 22, 1 << 27  # [B], of all texts, and of all other files
_ELEMENTS = 20_000  # greatest number of elements, after MuJoCo's compiler has copied them
_FIELDS = 200  # greatest number of attributes of an element; the compiler compares all pairs
# Elements that the compiler copies -> attribute with the numbers of copies.
_COPIES = {"replicate": "count", "composite": "count", "flexcomp": "count"}
_PIXELS = 1 << 24  # greatest number of pixels of a picture
# Elements with arrays -> attributes with the arrays' sizes, and the greatest product of the sizes.
_ARRAYS: dict[str, tuple[tuple[str, ...], int]] = {
    "hfield": (("nrow", "ncol"), 1 << 22),
    "texture": (("width", "height"), _PIXELS),
    "numeric": (("size",), 1 << 16),
    "size": (("nkey", "nuserdata"), 1 << 16),
    "mesh": (("params",), 1 << 9),
}
_PNG = b"\x89PNG\r\n\x1a\n"
_ENCODING = re.compile(rb"<\?xml\b[^>]{0,200}?\bencoding\s?=\s?[\"']([\w.-]{1,40})[\"']")
_TAGS = re.compile(r"<(?:option|compiler)\b[^<>]*>")
# Attributes of older files that MuJoCo no longer accepts; none of them changes an arm.
_DROPPED = re.compile(
    r"\s(?:collision|apirate|convexhull|exactmeshinertia)\s*=\s*(?:\"[^\"]*\"|'[^']*')"
)


class ArmText:
    """The text of an arm's file, and the texts of the files that it includes, without comments.

    Every other file that the texts name is a regular file of bounded size, if it exists.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        """Read the file, or the text of a file, which begins with "<".

        Raises:
            ArgumentError: a file is missing or no XML, or an element needs too much memory.
        """
        require_path_name("arm", path)
        text = os.fspath(path)
        self.path = None if text.lstrip().startswith("<") else Path(text)
        self.name = "arm" if self.path is None else text
        self.folder = Path() if self.path is None else self.path.parent
        self.includes: dict[str, bytes] = {}
        self.limits: dict[str, dict[str, str]] = {}  # joint of a URDF -> attributes of its <limit>
        self.is_urdf = False
        self._size = self._num = 0  # of texts [B], and of elements
        self._files: dict[tuple[str, str], None] = {}  # elements, and the files that they name
        self._meshdirs, self._bases = {"": None}, {self.folder: None}
        self._sizes: dict[Path, int] = {}  # [B]
        includes: list[tuple[str, Path]] = []
        if self.path is not None:
            text = self._read(self.path, "arm", "an MJCF or URDF file", "be", repr(text))
        self.text = self._scan(text, self.folder, includes)
        while includes:
            name, folder = includes.pop()
            if name in self.includes:
                continue  # the compiler refuses a file that is included twice
            place = self.folder / name
            place = place if os.path.exists(place) else folder / name
            element = f'{self.name}: include "{name}"'
            content = self._read(place, element, f"the file {self.folder / name}; put it there")
            self.includes[name] = self._scan(content, place.parent, includes).encode()
        places = {base / folder for base in self._bases for folder in self._meshdirs}
        if len(places) * len(self._files) > _ELEMENTS:
            raise self.error("the model", f"at most {_ELEMENTS} files, in all its folders")
        for element, file in self._files:
            for place in {folder / name for folder in places for name in (file, Path(file).name)}:
                self.check(element, place)

    def error(self, element: str, rule: str, verb: str = "have", shown: str = "") -> ArgumentError:
        """Return the error that an element of the file breaks a rule."""
        return ArgumentError(f"{self.name}: {element}", rule, verb=verb, shown=shown)

    def check(self, element: str, place: Path) -> None:
        """Raise if the compiler should not read a file that an element names and that exists."""
        if place in self._sizes or not os.path.exists(place) or os.path.isdir(place):
            return
        try:
            with open_plain(place, LARGEST_MESH) as file:
                head = file.read(24)
                self._sizes[place] = os.fstat(file.fileno()).st_size
        except OSError as error:
            raise self._bad_file(element, place, error.strerror or "") from None
        width, height = (int.from_bytes(head[k : k + 4]) for k in (16, 20))
        if head.startswith(_PNG) and width * height > _PIXELS:
            raise self._bad_file(element, place, f"{width} x {height} pixels")
        if sum(self._sizes.values()) > _FILES:
            raise self._bad_file(element, place, f"more than {_FILES >> 20} MiB in all files")

    def _bad_file(self, element: str, place: Path, shown: str) -> ArgumentError:
        rule = f"a plain file of at most {LARGEST_MESH >> 20} MiB and {_PIXELS} pixels at {place}"
        return self.error(element, rule, shown=shown)

    def _read(self, path: Path, name: str, rule: str, verb: str = "have", shown: str = "") -> str:
        """Return the text of a file in the encoding that it declares."""
        try:
            content = read_plain(path, _TEXTS - self._size)
        except (OSError, ValueError) as error:  # a path may have a zero byte
            reason = getattr(error, "strerror", None) or str(error)
            raise ArgumentError(
                name, rule, verb=verb, shown=f"{shown} ({reason})".strip()
            ) from None
        self._size += len(content)
        declared = _ENCODING.match(content.lstrip(b"\xef\xbb\xbf \t\r\n"))
        encoding = declared[1].decode() if declared else "utf-8-sig"
        try:
            return content.decode(encoding, "replace").removeprefix("\ufeff")
        except LookupError:
            raise ArgumentError(f"{path}: its encoding", "known", encoding) from None

    def _scan(self, text: str, folder: Path, includes: list[tuple[str, Path]]) -> str:
        """Return a text without comments and dropped attributes; check and note its elements."""
        text = _TAGS.sub(lambda tag: _DROPPED.sub("", tag[0]), _drop_comments(text))
        if "\ufffd" in text:
            raise self.error("the text", "in the encoding that the file declares, or UTF-8", "be")
        self._bases[folder] = None
        parser = expat.ParserCreate()
        above: list[tuple[str, dict[str, str], float]] = [("", {}, 1)]  # around the next element

        def start(tag: str, fields: dict[str, str]) -> None:
            parent, of_parent, num = above[-1]
            num *= _product([fields.get(_COPIES.get(tag, ""), "1")])
            above.append((tag, fields, num))
            self._num += num
            if not self._num <= _ELEMENTS or len(fields) > _FIELDS:
                rule = f"at most {_ELEMENTS} elements, with all copies, of {_FIELDS} attributes"
                raise self.error("the model", rule)
            names, most = _ARRAYS.get(tag, ((), 1))
            if not _product([fields.get(name, "1") for name in names]) <= most:
                shown = " ".join(f'{name}="{fields[name]}"' for name in names if name in fields)
                raise self.error(f"element {tag}", f"at most {most} entries", shown=shown)
            self.is_urdf |= tag == "robot" and len(above) == 2
            if (parent, tag) == ("joint", "limit"):
                self.limits[of_parent.get("name", "")] = fields
            for name, value in fields.items():
                if name in ("assetdir", "meshdir", "texturedir"):
                    self._meshdirs[value] = None
                elif name.startswith("file") and tag in ("include", "model"):
                    includes.append((value, folder))
                elif name.startswith("file"):
                    label = fields.get("name") or Path(value).stem
                    self._files[f'{tag} "{label}"', value] = None

        def refuse(*_: object) -> None:
            raise self.error("the file", "no <!DOCTYPE>; remove it")

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda _: above.pop()
        parser.StartDoctypeDeclHandler = refuse
        try:
            parser.Parse(text.lstrip(), True)
        except (expat.ExpatError, UnicodeEncodeError) as error:
            raise self.error("the model", f"accepted by MuJoCo: no XML, {error}", "be") from None
        return text


def _drop_comments(text: str) -> str:
    """Return an XML text without comments, with the same number of lines."""
    kept, first = [], 0
    while (begin := text.find("<!--", first)) >= 0 and (end := text.find("-->", begin + 4)) >= 0:
        kept += [text[first:begin], "\n" * text.count("\n", begin, end)]
        first = end + 3
    return "".join([*kept, text[first:]])


def _product(texts: list[str]) -> float:
    """Return the product of all numbers in texts; the compiler names a text that is no number."""
    try:
        return math.prod(max(float(each), 1.0) for text in texts for each in text.split())
    except ValueError:
        return 1.0
