"""Whole experiments: register from files to a run folder, simulate and register a demo, say what a file holds."""

from torchkcreg.experiments.demo import demo
from torchkcreg.experiments.describe import describe, describe_installation
from torchkcreg.experiments.figures import draw_registration
from torchkcreg.experiments.register_files import RegistrationFiles, register_files, resolve_config

__all__ = [
    "RegistrationFiles",
    "demo",
    "describe",
    "describe_installation",
    "draw_registration",
    "register_files",
    "resolve_config",
]
