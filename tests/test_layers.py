"""How the package is laid out: floors, levels, sizes, names, one way of importing, and who touches a disk."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "torchkcreg"
FILES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file())
MOST_LEVELS = 6
MOST_LINES = 400
SMALL = 80  # lines


def table_of_floors() -> dict[str, int]:
    """The floor of each folder and top-level file, from the table in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.+?) \|$", text, re.MULTILINE)
    return {name: int(floor) for floor, names in rows for name in re.findall(r"`(\w+)(?:/|\.py)`", names)}


FLOORS = table_of_floors()


def imports_of(path: Path) -> set[str]:
    """Folders (or top-level modules) of the package that a file imports, lazily or not."""
    package = ["torchkcreg", *path.relative_to(PACKAGE).parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            modules = [".".join([*base, *(node.module or "").split("."), alias.name]) for alias in node.names]
            modules = [module.replace("..", ".") for module in modules]
        elif isinstance(node, ast.ImportFrom):
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        parts = [module.split(".") for module in modules]
        found |= {part[1] for part in parts if part[0] == "torchkcreg" and len(part) > 1}
    return found


def test_every_folder_and_file_has_a_floor():
    files = {path.stem for path in PACKAGE.glob("*.py") if not path.stem.startswith("__")}
    assert {*FOLDERS, *files} == FLOORS.keys()


def test_the_floors_are_seen_to_be_used():
    assert "geometry" in imports_of(PACKAGE / "scene" / "assembly.py")
    assert "projector" in imports_of(PACKAGE / "projector" / "point_cloud.py")


@pytest.mark.parametrize("folder", FLOORS)
def test_a_folder_imports_only_from_lower_floors_and_knows_none_on_its_own(folder):
    files = sorted((PACKAGE / folder).rglob("*.py")) or [PACKAGE / f"{folder}.py"]
    assert files
    for path in files:
        where = path.relative_to(PACKAGE)
        assert imports_of(path) <= FLOORS.keys(), f"{where} imports from the package's top, which holds every floor"
        for other in imports_of(path) - {folder}:
            assert FLOORS[other] < FLOORS[folder], f"{where} (floor {FLOORS[folder]}) imports {other}"


def neighbours_of(path: Path) -> set[str]:
    """Files of the same folder that a file imports, lazily or for its types only, too."""
    package = ["torchkcreg", path.parent.name]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        module = (node.module or "").split(".") if node.module else []
        full = [*package, *module] if node.level == 1 else module if node.level == 0 else []
        if full[:2] == package:
            found |= {full[2]} if len(full) > 2 else {alias.name for alias in node.names}
    return {name for name in found if (path.parent / f"{name}.py").is_file()}


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_files_of_a_folder_stand_on_few_levels_and_in_no_circle(folder):
    imports = {p.stem: neighbours_of(p) for p in (PACKAGE / folder).glob("*.py") if p.stem != "__init__"}
    levels: dict[str, int] = {}
    while len(levels) < len(imports):
        ready = [name for name in imports if name not in levels and imports[name] <= levels.keys()]
        assert ready, f"{folder}: {', '.join(sorted(imports.keys() - levels.keys()))} import each other"
        levels |= {name: 1 + max((levels[below] for below in imports[name]), default=0) for name in ready}
    assert max(levels.values(), default=0) <= MOST_LEVELS, sorted(levels.items(), key=lambda item: item[1])


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_has_one_subject_and_stays_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES
    assert path.name != "utils.py"


REASONS = {
    "mechanics/bodies.py": "which parts of an implant touch, before there is an elastic body",
    "deformation/ffd.py": "the paper's model, which users look for under this name",
    "deformation/reading.py": "reads every model, so it imports them all",
    "evaluation/regions.py": "public functions of their own subject",
    "implant/known_component.py": "what a reconstruction needs of an implant",
    "io/volumes.py": "one format, one file",
    "kernels/gpu/filters.py": "one kernel, one file",
    "kernels/gpu/splines.py": "one kernel, one file",
    "optimization/adam.py": "one optimiser, one file",
    "optimization/cmaes.py": "one optimiser, one file",
    "projector/voxel_ops.py": "operators stand beside their reference and their module",
    "search/region.py": "where an implant may be, apart from how it is searched there",
    "similarity/similarity.py": "the interface of a user's own similarity",
    "physics/detector.py": "the one conversion of counts to line integrals",
    "visualization/case.py": "one figure, one file",
    "visualization/comparison.py": "one figure, one file",
    "visualization/load.py": "one figure, one file",
    "visualization/plan.py": "one figure, one file",
}


def importers() -> dict[str, set[str]]:
    """The files that import each module of the package, the folders' `__init__.py` aside."""
    found: dict[str, set[str]] = {str(path.relative_to(PACKAGE)): set() for path in FILES}
    for path in FILES:
        package = ["torchkcreg", *path.relative_to(PACKAGE).parts[:-1]]
        if path.name == "__init__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else []
                module = [*base, *(node.module or "").split(".")] if node.module else base
                for full in (module, *([*module, alias.name] for alias in node.names)):
                    name = "/".join(full[1:]) + ".py"
                    if name in found:
                        found[name].add(str(path.relative_to(PACKAGE)))
    return found


def test_a_small_module_with_one_importer_has_a_reason():
    fragments = {
        name
        for name, by in importers().items()
        if len(by) <= 1
        and not name.startswith(("cli/", "commands/"))
        and not name.endswith(("__init__.py", "__main__.py"))
        and len((PACKAGE / name).read_text(encoding="utf-8").splitlines()) < SMALL
    }
    assert fragments <= REASONS.keys(), "fold them into their subject, or say why they stand alone"
    assert {name for name in REASONS if not (PACKAGE / name).is_file()} == set()


COMMANDS = {path.stem for path in (PACKAGE / "cli").glob("*.py")} - {"__init__", "command"}
OF_STUDIES = {"experiment", "study"}  # their work is in studies/
SAME_SUBJECT = {
    "beam": {"physics", "kernels/gpu"},
    "config": {"io", "registration"},
    "densitometry": {"evaluation"},
    "displacement_map": {"evaluation", "visualization"},
    "experiment": {"studies/paper"},
    "geometry": {"io", "visualization"},
    "point_cloud": {"implant", "projector"},
    "register": {"registration"},
    "voxels": {"projector", "kernels/gpu"},
}


def test_a_file_name_stands_for_one_subject():
    places: dict[str, set[str]] = {}
    for path in FILES:
        if path.stem not in ("__init__", "__main__"):
            places.setdefault(path.stem, set()).add(str(path.parent.relative_to(PACKAGE)))
    for name, folders in places.items():
        of_command = {"cli", "commands", "visualization"} if name in COMMANDS else set()
        assert len(folders) == 1 or folders <= of_command | SAME_SUBJECT.get(name, set()), f"{name}.py: {folders}"


def test_a_public_name_means_one_thing():
    meanings: dict[str, tuple[str, object]] = {}
    for folder in FOLDERS:
        module = importlib.import_module(f"torchkcreg.{folder}")
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            other, same = meanings.setdefault(name, (folder, value))
            assert same is value, f"{name} is one thing in {other} and another in {folder}"


@pytest.mark.parametrize("command", sorted(COMMANDS - {"completion"} - OF_STUDIES))
def test_a_command_has_its_flags_in_one_file_and_its_work_in_another(command):
    flags = (PACKAGE / "cli" / f"{command}.py").read_text(encoding="utf-8")
    assert f"def add_{command}(" in flags
    assert (PACKAGE / "commands" / f"{command}.py").is_file()


def test_reconstruction_knows_nothing_of_registration():
    known = set().union(*(imports_of(path) for path in (PACKAGE / "reconstruction").rglob("*.py")))
    assert not known & {"registration", "scene", "deformation", "commands"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_are_relative_inside_a_folder_and_absolute_across(path):
    here = ".".join(["torchkcreg", *path.relative_to(PACKAGE).parts[:-1]])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level <= 1, f"line {node.lineno}: from {'.' * node.level}{node.module or ''}"
            inside = node.level == 0 and path.parent != PACKAGE and f"{node.module}.".startswith(f"{here}.")
            assert not inside, f"line {node.lineno}: from {node.module}, which is the file's own folder"


TOUCHES = {"open", "write_text", "write_bytes", "read_text", "read_bytes", "savefig", "save", "savez", "load"}
ON_DISK = {
    "physics/materials.py": "tables that come with the package",
    "registration/result.py": "a result's own save and load",
    "studies/paper/experiment.py": "recipes that come with the package",
    "visualization/page.py": "style and scripts that come with the package",
    "commands/report.py": "logs of any encoding",
}


def test_only_io_reads_and_writes_files():
    touching = set()
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "open":
                touching.add(path)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in TOUCHES:
                owner = node.func.value
                if not (isinstance(owner, ast.Name) and owner.id in ("json", "yaml", "self", "cls")):
                    touching.add(path)
    names = {str(path.relative_to(PACKAGE)) for path in touching}
    assert {name for name in names if not name.startswith(("io/", "kernels/"))} <= ON_DISK.keys()


FACTORIES = {"arange", "empty", "eye", "full", "linspace", "ones", "rand", "randn", "tensor", "zeros"}
ON_ANY_DEVICE = ("deformation", "optimization", "projector", "registration", "scene", "search", "similarity", "splines")


def without_device(path: Path) -> list[str]:
    """Calls of torch's factories that name no device, and casts to single precision."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        of_torch = isinstance(node.func.value, ast.Name) and node.func.value.id == "torch"
        if of_torch and node.func.attr in FACTORIES and all(keyword.arg != "device" for keyword in node.keywords):
            found.append(f"{path.name}:{node.lineno} torch.{node.func.attr} without a device")
        if node.func.attr == "float" and not node.args and not of_torch:
            found.append(f"{path.name}:{node.lineno} .float(): images have the data's precision")
    return found


@pytest.mark.parametrize("folder", ON_ANY_DEVICE)
def test_tensors_are_made_on_a_device_that_is_named_and_images_in_the_datas_precision(folder):
    found = [line for path in sorted((PACKAGE / folder).glob("*.py")) for line in without_device(path)]
    assert not found, "\n".join(found)
