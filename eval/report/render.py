"""Pages from templates, and files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from cdpipe.core.errors import InputError

_FILES = ("page.html", "comparison.html", "parts.html", "page.css", "charts.js")


def rendered(template: str, content: Mapping[str, Any]) -> str:
    """Return a page of its template's name; a name that the content lacks is an error."""
    folder = resources.files("eval") / "report" / "templates"
    environment = jinja2.Environment(
        loader=jinja2.DictLoader({name: (folder / name).read_text(encoding="utf-8") for name in _FILES}),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(content)


def written(path: Path, content: str | bytes) -> None:
    """Write a file.

    Raises:
        InputError: It cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
