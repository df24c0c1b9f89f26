"""Presets: named sets of settings, shipped, of plugins, and on the search path."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import PRESETS, find_yaml
from cdpipe.core.yamlfile import (
    Document,
    apply_settings,
    read_yaml,
    read_yaml_text,
    setting_lines,
    split_section,
    suggest,
    validate,
)
from cdpipe.model.config.pipeline import PipelineConfig

Site = Literal["narrow", "wide"]
WEIGHTS = ("descriptor.weights", "sphere.weights", "range_net.weights")
# The same, as `model_dump` excludes them.
WEIGHTS_FILES = {setting.partition(".")[0]: {"weights"} for setting in WEIGHTS}
"""Settings that name a file; a relative path starts at the file that holds the setting."""


def preset_names() -> list[str]:
    """Return the names of all presets: shipped, of plugins, and on the search path."""
    return list(preset_files())


def load_config(
    preset: str = "tunnelcd", settings: Iterable[str] | Mapping[str, Any] = (), site: Site = "narrow"
) -> PipelineConfig:
    """Read a preset and apply settings to it.

    Args:
        preset: Name of a preset, or the path of a .yaml file. Its settings are for narrow drifts; the section `wide`
            has those that differ in wide drifts: the radius, and with it the threshold. Where the radius follows the
            width of the drift, a preset needs no such section. Relative paths in it start at that file.
        settings: Replace those of the preset: `["query.radius_m=6"]`, `{"query.radius_m": 6}` or
            `{"query": {"radius_m": 6}}`. Relative paths start at the working folder.
        site: Narrow or wide drifts; no matter for a preset whose radius follows the width.

    Raises:
        InputError: The preset is unknown or has no settings for the site, or keys or values are wrong. All mistakes for
            both sites are reported at once.
    """
    settings = setting_lines(settings)
    narrow, wide = split_section(_preset_document(preset), "wide")
    found: dict[str, PipelineConfig] = {}
    mistakes: dict[str, None] = {}
    for name, document in (("narrow", narrow), ("wide", wide)):
        try:
            if document is not None:
                found[name] = validate(PipelineConfig, apply_settings(document, settings))
        except InputError as error:
            mistakes |= dict.fromkeys(str(error).splitlines())
    if mistakes:
        raise InputError("\n".join(mistakes))
    if site in found:
        return found[site]
    if found["narrow"].query.radius_m == "width" or _follows_width(narrow):
        return found["narrow"]
    raise InputError(
        f"{narrow.source}: wide: missing: this preset does not say what it needs in wide drifts; "
        "expected e.g. wide: {query: {radius_m: 10, threshold: 0.5}}"
    )


def _preset_document(preset: str) -> Document:
    if preset.endswith((".yaml", ".yml")):
        return _resolve_files(read_yaml(Path(preset)), Path(preset).parent)
    presets = preset_files()
    if preset not in presets:
        raise InputError(f"preset {preset!r} is unknown{suggest(preset, presets)} (known: {', '.join(presets)})")
    document = read_yaml(Path(f"{preset}.yaml"), read_yaml_text(presets[preset]))
    return _resolve_files(document, Path(str(presets[preset])).parent)


def _follows_width(preset: Document) -> bool:
    """Return whether the radius of a preset, before settings over it, follows the width of the drift."""
    query = preset.value.get("query")
    return isinstance(query, dict) and query.get("radius_m") == "width"


def _resolve_files(document: Document, folder: Path) -> Document:
    """Return a preset whose relative paths start at its folder, as seen from the working folder."""

    def resolve(tree: Any, key: str = "") -> Any:
        if isinstance(tree, dict):
            return {name: resolve(value, f"{key}.{name}".removeprefix(".")) for name, value in tree.items()}
        is_file = key.removeprefix("wide.") in WEIGHTS and isinstance(tree, str) and tree
        return str(folder / tree) if is_file else tree

    return replace(document, value=resolve(document.value))


def preset_files() -> dict[str, Traversable]:
    """Return the file of every preset by its name: shipped, of plugins, and on the search path."""
    return find_yaml("presets", resources.files("cdpipe") / "methods" / "presets", group=PRESETS)
