"""Deformable known-component 3D-2D registration of metal implants in cone-beam CT."""

__version__ = "0.1.0"
