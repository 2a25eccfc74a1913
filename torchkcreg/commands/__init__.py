"""Functions behind the commands: from input files to a folder of results. One module per command, of the same name."""

from .assess import VisitFiles, assess
from .assessment import Assessment
from .compare import Comparison, compare_files
from .convert import convert
from .demo import demo
from .densitometry import densitometry_files
from .doctor import doctor, self_test
from .evaluate import FileEvaluation, evaluate_files
from .follow import Healing, follow
from .info import describe, describe_installation, picture_geometry, runs_compared
from .load import ImplantLoad, load_files
from .plan import ViewPlan, plan_files
from .reconstruct import reconstruct_files, resolve_options
from .reconstruct_inputs import registered_components
from .reconstruct_options import ReconstructionFiles, ReconstructionOptions
from .register import RegistrationFiles, dry_run, register_files, resolve_config
from .register_frames import FrameSeries, register_frames
from .report import write_report
from .seeds import SeedRuns, register_seeds
from .simulate import SimulatedFiles, simulate_files
from .visit_page import ASSESSMENT, write_visit_page
from .warp import warp_files

__all__ = [
    "ASSESSMENT",
    "Assessment",
    "Comparison",
    "FileEvaluation",
    "FrameSeries",
    "Healing",
    "ImplantLoad",
    "ReconstructionFiles",
    "ReconstructionOptions",
    "RegistrationFiles",
    "SeedRuns",
    "SimulatedFiles",
    "ViewPlan",
    "VisitFiles",
    "assess",
    "compare_files",
    "convert",
    "demo",
    "densitometry_files",
    "describe",
    "describe_installation",
    "doctor",
    "dry_run",
    "evaluate_files",
    "follow",
    "load_files",
    "picture_geometry",
    "plan_files",
    "reconstruct_files",
    "register_files",
    "register_frames",
    "register_seeds",
    "registered_components",
    "resolve_config",
    "resolve_options",
    "runs_compared",
    "self_test",
    "simulate_files",
    "warp_files",
    "write_report",
    "write_visit_page",
]
