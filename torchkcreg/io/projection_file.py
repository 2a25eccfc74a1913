"""Projections that stay on the disk: scans that are larger than memory, read some views at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from torchkcreg.io.files import existing_file
from torchkcreg.io.images import num_slices, read_slices
from torchkcreg.io.projections import IMAGE_SUFFIXES, Projections, check_views, converted


class ProjectionFile:
    """A file of projections of which some views are read at a time; `len` says how many there are.

    Files: `.npy`, and the images that `read_projections` reads; compressed ones are unpacked as a whole each time. A
    detector's ceiling, and pixels that are stuck there, are told from the views that are read together.

    Args:
        path: The file.
        open_beam: Intensity of the unattenuated beam, one number or one image; line integrals if None.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or is an `.npz`, which can only be read as a whole.
    """

    def __init__(self, path: str | os.PathLike[str], *, open_beam: ArrayLike | None = None) -> None:
        self.path, self.open_beam = existing_file(path, "projections"), open_beam
        self._array = None
        try:
            if self.path.suffix.lower() == ".npy":
                self._array = np.load(self.path, mmap_mode="r", allow_pickle=False)
                self._num_views = len(self._array)
            elif self.path.name.lower().endswith(IMAGE_SUFFIXES):
                self._num_views = num_slices(self.path)
            else:
                raise ValueError("views are read one by one from .npy and images: write it as one of these")
        except (ValueError, RuntimeError, OSError, TypeError) as error:
            raise self._error(error) from error

    def __len__(self) -> int:
        return self._num_views

    def read(self, views: Sequence[int]) -> Projections:
        """Some views, in this order, as `read_projections` gives them.

        Raises:
            ValueError: If there is no such view, or what it holds is no image.
        """
        try:
            check_views(views, len(self))
            image = read_slices(self.path, views) if self._array is None else np.asarray(self._array[list(views)])
            return converted({"image": image}, self.open_beam, None, None)
        except (ValueError, RuntimeError) as error:
            raise self._error(error) from error

    def _error(self, error: Exception) -> ValueError:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        return ValueError(f"projections file {self.path}: {reason}")
