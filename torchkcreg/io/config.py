"""Configuration files (YAML or JSON) that describe a run."""

from __future__ import annotations

import os
import re
from typing import Any

import yaml

from torchkcreg.plain import first_line, plain

from .files import read_text, write_text


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that rejects duplicate keys (plain YAML silently takes the last)."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)  # type: ignore[no-untyped-call]
            if isinstance(key, str) and key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is given twice", key_node.start_mark)
            seen.add(key if isinstance(key, str) else repr(key))
        return super().construct_mapping(node, deep)


# YAML 1.1 reads on, off, yes and no as truth values; YAML 1.2 and the documentation mean words.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
# YAML 1.1 reads 1e-4 (no decimal point) as a string.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML or JSON file (JSON is YAML). An empty file gives an empty mapping.

    Values are plain data: nothing in the file is executed. Keys and values are validated by the caller.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is not valid YAML, is no mapping, or has a duplicate or non-string key. Syntax errors and
            duplicate keys are reported with their line.
    """
    text = read_text(path, "configuration")
    try:
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(f"configuration file {path} is not valid YAML: {_one_line(error)}") from error
    content = {} if content is None else content
    if not isinstance(content, dict):
        raise ValueError(f"configuration file {path} must hold keys and values, got {type(content).__name__}")
    for key in content:
        if not isinstance(key, str):
            raise ValueError(f"configuration file {path}: keys must be texts, got {key!r}")
    return content


def write_config(path: str | os.PathLike[str], config: dict[str, Any]) -> None:
    """Write a mapping of plain data as YAML, keeping the order of its keys."""
    write_text(path, yaml.safe_dump(plain(config), sort_keys=False, allow_unicode=True, width=120))


def _one_line(error: Exception) -> str:
    problem = getattr(error, "problem", None)
    mark = getattr(error, "problem_mark", None)
    text = str(problem) if problem else first_line(error, otherwise="cannot be parsed")
    return text if mark is None else f"line {mark.line + 1}: {text}"
