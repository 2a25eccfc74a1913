"""Builds the C++ kernels; everything else about the package is in setup.cfg.

The kernels are optional: where they don't compile, the package installs without them, compiles them at first use, or
runs on its torch reference.
"""

import runpy
import warnings
from pathlib import Path

from setuptools import setup
from torch.utils.cpp_extension import BuildExtension, CppExtension

PACKAGE = "torchkcreg"
BUILD = runpy.run_path(str(Path(__file__).parent / PACKAGE / "kernels" / "extension.py"))


class OptionalBuildExtension(BuildExtension):
    """A build step whose failure is a warning."""

    def run(self) -> None:
        try:
            super().run()
        except Exception as error:  # compilers fail in many ways, and none of them should keep the package out
            lines = str(error).strip().splitlines() or [type(error).__name__]
            warnings.warn(f"{PACKAGE} is installed without its C++ kernels: {lines[0]}", stacklevel=2)
            self.extensions = []  # or setuptools looks for the files

    def get_export_symbols(self, ext) -> list[str]:
        """No symbols: torch loads the library, Python does not import it."""
        return []


setup(
    ext_modules=[
        CppExtension(
            f"{PACKAGE}._C",
            [f"{PACKAGE}/{source}" for source in BUILD["SOURCES"]],
            depends=[str(path) for path in Path(PACKAGE, "csrc").rglob("*.h")],
            extra_compile_args=[*BUILD["COMPILE_FLAGS"], *BUILD["DEFINES"]],
            py_limited_api=True,
        )
    ],
    cmdclass={"build_ext": OptionalBuildExtension},
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
)
