import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "torchkcreg"
FLOORS = {
    "callbacks": 0,
    "config": 0,
    "console": 1,
    "progress": 0,
    "differentiable": 0,
    "parameters": 0,
    "plain": 0,
    "precision": 0,
    "kernels": 0,
    "geometry": 1,
    "physics": 1,
    "similarity": 1,
    "implant": 2,
    "projector": 2,
    "optimization": 1,
    "splines": 2,
    "mechanics": 3,
    "deformation": 4,
    "scene": 5,
    "registration": 6,
    "reconstruction": 6,
    "simulation": 6,
    "io": 7,
    "evaluation": 7,
    "visualization": 8,
    "experiments": 9,
    "studies": 10,
    "cli": 11,
}
MOST_LEVELS = 6
FOLDERS = sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file())


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


def test_every_folder_has_a_floor():
    assert set(FOLDERS) <= FLOORS.keys()


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


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_has_one_subject_and_stays_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 260
    assert path.name != "utils.py"


FACTORIES = {"arange", "empty", "eye", "full", "linspace", "ones", "rand", "randn", "tensor", "zeros"}
ON_ANY_DEVICE = ("deformation", "optimization", "projector", "registration", "scene", "similarity", "splines")


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
