"""Pages from templates, and files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from eval.core.figures import compress_address

_FILES = (
    "page.html", "index.html", "comparison.html", "answer.html", "story.html", "leaderboard.html", "parts.html",
    "page.css", "parts.css", "page.js", "charts.js", "answer.js",
)  # fmt: skip


def render_page(template: str, content: Mapping[str, Any]) -> str:
    """Return a page made from a template; a name that the content lacks is an error."""
    folder = resources.files("eval") / "report" / "templates"
    environment = jinja2.Environment(
        loader=jinja2.DictLoader({name: (folder / name).read_text(encoding="utf-8") for name in _FILES}),
        autoescape=True,
        finalize=_shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["compress"] = compress_address
    return environment.get_template(template).render(content)


def _shown(value: Any) -> Any:
    """Return a value of the content with control characters as escapes, line breaks apart; markup stays as it is."""
    is_text = isinstance(value, str) and not hasattr(value, "__html__")
    return "\n".join(map(visible, value.split("\n"))) if is_text else value


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file.

    Raises:
        InputError: It cannot be written.
    """
    try:
        with whole_file(path) as partial:
            partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
