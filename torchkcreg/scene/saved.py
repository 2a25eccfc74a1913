"""A scene as plain types and tensors, and back."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchkcreg.deformation import deformation_from_dict
from torchkcreg.implant import Component, ImplantPointCloud, Screw
from torchkcreg.physics import intensity_from_dict
from torchkcreg.plain import require_keys

from .assembly import Assembly
from .scene import Scene

_CLOUD = ("points", "volumes", "cell")


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """The scene as a dict for `scene_from_dict`; the implants' holes are left out."""
    return {
        "assemblies": [_assembly_to_dict(assembly) for assembly in scene],
        "intensity": scene.intensity.to_dict(),
        "materials": scene.materials,
        "metals": scene.metals,
        "backend": scene.backend,
    }


def scene_from_dict(content: Any) -> Scene:
    """The scene that `scene_to_dict` wrote.

    Raises:
        ValueError: If a key is missing or malformed; the message names it.
    """
    require_keys(content, ("assemblies", "intensity", "materials"), " of a scene")
    return Scene(
        [_assembly_from_dict(assembly) for assembly in content["assemblies"]],
        intensity_from_dict(content["intensity"]),
        metals=content.get("metals", ()),
        materials=content["materials"],
        backend=content.get("backend", "auto"),
    )


def _assembly_to_dict(assembly: Assembly) -> dict[str, Any]:
    components = [
        {
            "name": c.name,
            "cloud": _cloud_to_dict(c.cloud),
            "material": c.material,
            "head": c.head,
            "axis": c.axis,
            "screw": None if c.as_screw is None else c.as_screw.to_dict(),
        }
        for c in assembly.components
    ]
    return {
        "name": assembly.name,
        "material": assembly.material,
        "cloud": _cloud_to_dict(assembly.implant),
        "deformation": assembly.deformation.to_dict(),
        "implant_to_world": assembly.implant_to_world.detach(),
        "components": components,
        "tilts": assembly.tilts,
        "follow_radius_mm": assembly.follow_radius_mm,
    }


def _assembly_from_dict(content: Any) -> Assembly:
    require_keys(content, ("cloud", "deformation", "implant_to_world", "components", "tilts"), " of an assembly")
    components = [
        Component(
            c["name"],
            _cloud(c["cloud"]),
            c["material"],
            c["head"],
            c["axis"],
            screw=None if c["screw"] is None else Screw(**c["screw"]),
        )
        for c in content["components"]
    ]
    assembly = Assembly(
        _cloud(content["cloud"]),
        deformation_from_dict(content["deformation"]),
        implant_to_world=content["implant_to_world"],
        material=content["material"],
        components=components,
        follow_radius_mm=content["follow_radius_mm"],
        name=content["name"],
    )
    assembly.tilts = content["tilts"].clone()
    return assembly


def _cloud_to_dict(cloud: ImplantPointCloud) -> dict[str, Tensor]:
    return {name: getattr(cloud, name).cpu() for name in _CLOUD}


def _cloud(content: Any) -> ImplantPointCloud:
    require_keys(content, _CLOUD, " of a cloud")
    return ImplantPointCloud(*(content[name] for name in _CLOUD))
