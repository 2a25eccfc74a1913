"""Results of an earlier format."""

from __future__ import annotations

from typing import Any

from torchkcreg.plain import require_keys


def upgraded(content: dict[str, Any]) -> dict[str, Any]:
    """Plain data of format version 1, which knew one implant and other stages, as version 2.

    Raises:
        ValueError: If a key is missing.
    """
    of_implant = ("implant_to_world", "components", "grid", "control_points_mm", "labels", "screws_found")
    require_keys(content, ("implant_to_world", "grid", "control_points_mm", "labels", "gc", "config"))
    found = [{**screw, "name": f"found{i}"} for i, screw in enumerate(content.get("screws_found", []))]
    implant = {
        "implant_to_world": content["implant_to_world"],
        "material": content["config"].get("material"),
        "deformation": {"model": "ffd", **{key: content[key] for key in ("grid", "control_points_mm", "labels")}},
        "components": content.get("components", {}),
        "screws": found,
        "found": [screw["name"] for screw in found],
    }
    options = {key: value for key, value in content["config"].items() if key != "stages"}
    rest = {key: value for key, value in content.items() if key not in of_implant}
    return {**rest, "format_version": 2, "implants": [implant], "config": options}
