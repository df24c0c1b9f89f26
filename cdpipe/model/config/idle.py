"""Settings that a method does not read: those of another source of regions are refused, of another extraction told."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.model.config.comparison import SOURCES_AT_KEYFRAMES, WHOLE_MAP_SOURCES
from cdpipe.model.config.pipeline import PipelineConfig

# sources that read the section of another one
_BORROWED: Mapping[str, tuple[str, ...]] = MappingProxyType({"m3c2": ("m3c2-ep",)})
# sources with the name of a rival of the displacement that reads the same section
_OF_SURFACES = ("m3c2", "m3c2-ep")

_SURFACE_KEYS = ("recentre", "realign", "seed_m", "border_m", "min_cells", "min_views", "movers")
# which extractions read a setting; sources that compare whole maps read some of these, too
_OF_EXTRACTION: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        **dict.fromkeys(("extract.voxel_m", "extract.min_points", "extract.origin_m"), ("voxel",)),
        "extract.distance_m": ("nearest",),
        **dict.fromkeys((f"extract.{key}" for key in _SURFACE_KEYS), ("surface",)),
        **dict.fromkeys(("cluster.min_points", "cluster.radius_m"), ("voxel", "nearest")),
        **dict.fromkeys(("outlier.neighbours", "outlier.sigmas"), ("voxel", "nearest")),
    }
)
_OF_WHOLE_MAPS = ("cluster.radius_m", "outlier.neighbours", "outlier.sigmas")


def list_idle_settings(config: PipelineConfig, settings: Iterable[str]) -> list[str]:
    """Return those of some settings that a method does not read; a plugin's source may read any.

    One that is the default is none of them: the settings that an answer states hold sections that it did not read.

    Args:
        config: The settings of the method.
        settings: Settings `key=value`, or keys, that somebody gave.
    """
    if config.regions.source not in (*SOURCES_AT_KEYFRAMES, *WHOLE_MAP_SOURCES):
        return []
    readers = {source.replace("-", "_"): (source, *_BORROWED.get(source, ())) for source in WHOLE_MAP_SOURCES}
    found = []
    for setting in settings:
        section, _, key = setting.partition("=")[0].partition(".")
        of_section = readers.get(section, ())
        of_surface = [name for name in of_section if name in _OF_SURFACES]
        is_read = config.regions.source in of_section or config.surface.method in of_surface
        if of_section and not is_read and not _is_default(config, section, key):
            found.append(setting)
    return found


def list_unread_settings(config: PipelineConfig, settings: Iterable[str]) -> list[str]:
    """Return those of some settings that the extraction of a method does not read, as `list_idle_settings` does."""
    if config.regions.source not in (*SOURCES_AT_KEYFRAMES, *WHOLE_MAP_SOURCES):
        return []
    of_source = _OF_WHOLE_MAPS if config.regions.source in WHOLE_MAP_SOURCES else ()
    found = []
    for setting in settings:
        name = setting.partition("=")[0]
        is_read = name in of_source or config.extract.method in _OF_EXTRACTION.get(name, (config.extract.method,))
        if not is_read and not _is_default(config, *name.split(".")):
            found.append(setting)
    return found


def explain_unread_setting(setting: str, methods: Sequence[str]) -> str:
    """Return one line on a setting that no method reads whose extractions are `methods`."""
    name = setting.partition("=")[0]
    ways = " or ".join(f"extract.method={method}" for method in _OF_EXTRACTION[name])
    return (
        f"{setting} changes nothing: extract.method = {' and '.join(dict.fromkeys(methods))} does not read it; "
        f"set {ways} as well"
    )


def _is_default(config: PipelineConfig, section: str, key: str) -> bool:
    values = (getattr(each, section) for each in (config, PipelineConfig()))
    one, other = (getattr(each, key) if key else each for each in values)
    return bool(one == other)


def explain_idle_setting(setting: str, sources: Sequence[str]) -> str:
    """Return one line on a setting that no method reads whose sources of regions are `sources`."""
    section = setting.partition("=")[0].partition(".")[0]
    source = section.replace("_", "-")
    ways = f"regions.source={source}" + (f" or surface.method={source}" if source in _OF_SURFACES else "")
    return (
        f"{setting}: regions.source = {' and '.join(dict.fromkeys(sources))} does not read the section {section}: "
        f"leave it out, or set {ways}"
    )


def require_settings_are_read(config: PipelineConfig, settings: Iterable[str]) -> None:
    """Refuse settings that the method does not read: they would change nothing.

    Raises:
        InputError: One of them is of the section of another source of regions.
    """
    if idle := list_idle_settings(config, settings):
        raise InputError("\n".join(explain_idle_setting(each, [config.regions.source]) for each in idle))


def warn_of_unread_settings(config: PipelineConfig, settings: Iterable[str]) -> None:
    """Warn of settings that the extraction of the method does not read."""
    for setting in list_unread_settings(config, settings):
        warnings.warn(explain_unread_setting(setting, [config.extract.method]), InputWarning, stacklevel=3)
