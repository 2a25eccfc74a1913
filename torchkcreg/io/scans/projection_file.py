"""Projections that stay on the disk: scans that are larger than memory, read some views at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from torchkcreg.io.files import existing_place
from torchkcreg.io.scans.image_series import open_series
from torchkcreg.io.scans.measured import Projections, check_views, converted


class ProjectionFile:
    """A file of projections of which some views are read at a time; `len` says how many there are.

    Files: all that `read_projections` reads but `.npz`; compressed stacks are unpacked as a whole each time. A
    detector's ceiling, and pixels that are stuck there, are told from the views that are read together.

    Args:
        path: The file.
        open_beam: Intensity of the unattenuated beam, one number or one image; line integrals if None.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or is an `.npz`, which can only be read as a whole.
    """

    def __init__(self, path: str | os.PathLike[str], *, open_beam: ArrayLike | None = None) -> None:
        self.path, self.open_beam = existing_place(path, "projections"), open_beam
        if self.path.suffix.lower() == ".npz":
            raise self._error(ValueError("views are read one by one from all kinds but .npz: write it as another"))
        try:
            self._series = open_series(self.path)
        except (ValueError, RuntimeError, OSError, TypeError) as error:
            raise self._error(error) from error

    def __len__(self) -> int:
        return self._series.num_views

    def read(self, views: Sequence[int]) -> Projections:
        """Some views, in this order, as `read_projections` gives them.

        Raises:
            ValueError: If there is no such view, or what it holds is no image.
        """
        try:
            check_views(views, len(self))
            return converted(self._series.arrays(views), self._beam(views), None, None)
        except (ValueError, RuntimeError) as error:
            raise self._error(error) from error

    def _beam(self, views: Sequence[int]) -> ArrayLike | None:
        """The open beam of some views, where it is told for each."""
        beam = None if self.open_beam is None else np.asarray(self.open_beam)
        return beam[list(views)] if beam is not None and beam.ndim in (1, 3) and len(beam) == len(self) else beam

    def _error(self, error: Exception) -> ValueError:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        return ValueError(f"projections file {self.path}: {reason}")
