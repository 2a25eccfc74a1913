"""Options as validated, immutable objects, from Python, YAML or JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

_Config = TypeVar("_Config", bound="Config")


class Config(BaseModel):
    """Immutable options, validated on creation. Unknown options are an error.

    >>> class Walk(Config):
    ...     steps: int = 10
    >>> Walk.of({"steps": "many"}, "walk.yaml")
    Traceback (most recent call last):
    ValueError: walk.yaml: steps: Input should be a valid integer, unable to parse string as an integer
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def of(cls: type[_Config], options: Mapping[str, Any], source: str = "options") -> _Config:
        """Options from a mapping, such as the content of a file.

        Args:
            options: Values by their names.
            source: Name of the source in error messages.

        Raises:
            ValueError: If there are unknown names or invalid values. The message lists all of them in one line.
        """
        try:
            return cls.model_validate(dict(options))
        except ValidationError as error:
            problems = [
                ": ".join(filter(None, (".".join(map(str, e["loc"])), e["msg"].removeprefix("Value error, "))))
                for e in error.errors()
            ]
            raise ValueError(f"{source}: {'; '.join(problems)}") from None
