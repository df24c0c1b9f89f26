"""What casts the rays of a sensor: Embree, or Warp, which is an extra."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

from cdpipe.core.errors import InputWarning
from cdpipe.core.plugins import extra_version, has_extra, require_extra
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster, RayCaster

Backend = Literal["embree", "warp"]


def require_backend(backend: Backend) -> None:
    """Raise `InputError` unless the packages of a backend are installed."""
    if backend == "warp":
        require_extra("gpu", "sim.backend = warp")


def make_sensor_caster(backend: Backend, meshes: Sequence[Mesh], caster: Caster) -> RayCaster:
    """Return a ray caster of a backend for the meshes that Embree's caster has already.

    Warns of a backend that finds no GPU.

    Raises:
        InputError: The backend is not installed.
    """
    require_backend(backend)
    if backend == "embree":
        return caster
    from sim.geometry.warp_caster import WarpCaster  # noqa: PLC0415 - an extra

    if not find_gpu():
        told = "sim.backend = warp: no GPU was found: the CPU casts the rays, at a third of the speed of embree"
        warnings.warn(told, InputWarning, stacklevel=2)
    return WarpCaster(meshes, caster.centre_m)


def find_gpu() -> bool:
    """Return whether Warp is installed and finds a GPU."""
    if not has_extra("gpu"):
        return False
    from sim.geometry.warp_caster import start_device  # noqa: PLC0415 - an extra

    return start_device() != "cpu"


def name_backend(caster: RayCaster) -> str:
    """Return what cast a session, for its provenance: package, version and kind of device."""
    device = getattr(caster, "device", None)
    if device is None:
        return f"embreex {extra_version('embreex')}"
    return f"warp-lang {extra_version('warp-lang')} on {device.partition(':')[0]}"
