"""Reading of YAML files from users: fields with values, without references or repetitions."""

import os
import re
from typing import Any

import yaml

from planner_jax.host.files import read_plain

LARGEST = 3 << 14  # [B] greatest size of a file

Value = Any  # a field's value: text, number, list of texts and numbers, dictionary, or None


def read_fields(path: str | os.PathLike) -> dict[str, Value]:
    """Return the fields of a YAML file; JSON is a part of YAML.

    Raises:
        ValueError: the file holds no fields; the message says what it must be.
        OSError: the file cannot be read.
    """
    text = read_plain(path, LARGEST)
    try:
        fields = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"must be YAML, {' '.join(str(error).split())}") from None
    except (RecursionError, ValueError) as error:
        raise ValueError(f"must be YAML, got {str(error)[:60]}") from None
    if not isinstance(fields, dict) or not all(isinstance(name, str) for name in fields):
        raise ValueError(f"must be fields with values, got {fields!r:.60}")
    return fields


class _Loader(yaml.SafeLoader):
    """YAML loader that raises an error for repeated fields and for references (`*name`)."""

    def compose_node(self, parent: yaml.Node | None, index: Value) -> yaml.Node | None:
        """Compose a YAML node; raise an error for references, which can expand to a huge text."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(None, None, "no *reference", self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Value:
        names: set[str] = set()
        for key, _ in node.value:
            if str(key.value) in names:
                problem = f"{key.value} only once"
                raise yaml.MarkedYAMLError(None, None, problem, key.start_mark)
            names.add(str(key.value))
        return super().construct_mapping(node, deep)


# Numbers are written as in YAML 1.2: 010 is ten, 1e-3 is a number, 1:30 and 1_000 are texts.
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_Loader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0] not in _NUMBERS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern in zip(
    _NUMBERS,
    (
        r"[-+]?(?:0|[1-9]\d*)$",
        r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$",
    ),
    strict=True,
):
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), list("-+.0123456789"))
