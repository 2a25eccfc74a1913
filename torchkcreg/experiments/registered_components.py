"""The metal of a finished registration's run in its place: bent implants and screws as known components."""

from __future__ import annotations

from pathlib import Path

from torchkcreg.io import read_components, read_config, read_mesh, read_run
from torchkcreg.registration import RegistrationResult
from torchkcreg.scene import KnownComponent


def registered_components(
    run: Path,
    *,
    components: Path | None = None,
    material: str | None = None,
    pitch_mm: float | None = None,
    result: RegistrationResult | None = None,
) -> list[KnownComponent]:
    """The implant of a run as it was registered, then its screws, in world mm.

    Args:
        run: folder of a finished registration.
        components: screws to take instead of those of the registration, which were given to it or which it found;
            each follows the implant near its head.
        material: the implant's, where the registration had none.
        pitch_mm: of the nodes; the registration's if None.
        result: of the run, where it was read already.

    Raises:
        ValueError: nothing says what the implant is made of.
        FileNotFoundError: the run is not finished, or a file it was made from is gone.
    """
    result, files = result or read_run(run), read_config(Path(run) / "config.yaml").get("files") or {}
    meshes = [files["implant"]] if isinstance(files["implant"], str) else files["implant"]
    screws = None if components is None else read_components(components)
    if screws is not None and len(meshes) > 1:
        raise ValueError(f"run {run} has {len(meshes)} implants: screws cannot be named for all of them at once")
    known = []
    for implant, mesh in zip(result.implants, meshes, strict=True):
        try:
            own = implant.known_components(
                read_mesh(mesh), screws=screws, material=material, pitch=pitch_mm or result.config.pitch_mm
            )
        except ValueError as error:
            raise ValueError(f"run {run}: {error} with --material") from None
        known += own
    return known
