"""Pages from templates, and files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from eval.core.figures import compress_address
from eval.core.output import unwritable

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
        InputError: It cannot be written, or another process writes it.
    """
    write_files({path: content})


def write_files(files: Mapping[Path, str | bytes]) -> None:
    """Write files of which none takes its place before all are written.

    Another process is kept from all of them by the first one, which takes its place last: they never mix.

    Raises:
        InputError: One of them cannot be written, or another process writes it; all are left as they were.
    """
    path = Path()
    try:
        with ExitStack() as stack:
            for path, content in files.items():
                partial = stack.enter_context(whole_file(path))
                partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
    except BlockingIOError as error:
        raise unwritable(path, error) from error
    except OSError as error:
        raise InputError(f"{error.filename or path}: cannot be written: {error.strerror}") from error
