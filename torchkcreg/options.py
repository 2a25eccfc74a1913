"""Options as checked, unchanging objects, from Python, YAML or JSON alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

_Config = TypeVar("_Config", bound="Config")


class Config(BaseModel):
    """Options that are checked when they are made, and don't change; unknown ones are refused.

    >>> class Walk(Config):
    ...     steps: int = 10
    >>> Walk.of({"steps": "many"}, "walk.yaml")
    Traceback (most recent call last):
    ValueError: walk.yaml: steps: Input should be a valid integer, unable to parse string as an integer
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def of(cls: type[_Config], options: Mapping[str, Any], source: str = "options") -> _Config:
        """The options of a file.

        Args:
            options: By their names.
            source: What an error calls them.

        Raises:
            ValueError: For unknown names and wrong values, in one line that names them all.
        """
        try:
            return cls.model_validate(dict(options))
        except ValidationError as error:
            problems = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
            raise ValueError(f"{source}: {'; '.join(problems)}") from None
