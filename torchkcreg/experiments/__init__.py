"""Whole experiments: register from files to a run folder, simulate and register a demo, say what a file holds."""

from torchkcreg.experiments.capture import CaptureStudy, CaptureTrial, capture_study
from torchkcreg.experiments.compare_files import Comparison, compare_files
from torchkcreg.experiments.convert_files import convert
from torchkcreg.experiments.demo import demo
from torchkcreg.experiments.densitometry_files import densitometry_files
from torchkcreg.experiments.describe import describe, describe_installation, picture_geometry
from torchkcreg.experiments.dry_run import dry_run
from torchkcreg.experiments.evaluate_files import FileEvaluation, evaluate_files
from torchkcreg.experiments.figures import draw_registration
from torchkcreg.experiments.implant_of_run import implant_of_run
from torchkcreg.experiments.installation_check import doctor, self_test
from torchkcreg.experiments.load_files import ImplantLoad, load_files
from torchkcreg.experiments.plan_files import ViewPlan, plan_files
from torchkcreg.experiments.reconstruct_files import reconstruct_files, resolve_options
from torchkcreg.experiments.reconstruction_options import ReconstructionFiles, ReconstructionOptions
from torchkcreg.experiments.register_files import RegistrationFiles, register_files, resolve_config
from torchkcreg.experiments.registered_components import registered_components
from torchkcreg.experiments.report_files import write_report
from torchkcreg.experiments.runs_compared import runs_compared
from torchkcreg.experiments.seeds import SeedRuns, register_seeds
from torchkcreg.experiments.simulate_files import SimulatedFiles, simulate_files

__all__ = [
    "CaptureStudy",
    "CaptureTrial",
    "Comparison",
    "FileEvaluation",
    "ImplantLoad",
    "ReconstructionFiles",
    "ReconstructionOptions",
    "RegistrationFiles",
    "SeedRuns",
    "SimulatedFiles",
    "ViewPlan",
    "capture_study",
    "compare_files",
    "convert",
    "demo",
    "densitometry_files",
    "describe",
    "describe_installation",
    "doctor",
    "draw_registration",
    "dry_run",
    "evaluate_files",
    "implant_of_run",
    "load_files",
    "picture_geometry",
    "plan_files",
    "reconstruct_files",
    "register_files",
    "register_seeds",
    "registered_components",
    "resolve_config",
    "resolve_options",
    "runs_compared",
    "self_test",
    "simulate_files",
    "write_report",
]
