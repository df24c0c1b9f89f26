"""The scripts of the guides as files, which a user of `evaluate` starts from. They stand in the pages of the guides."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path
from typing import Literal

from eval.core.output import new_files

_PAGES = {"own": ("scoring", "ANSWERS.md", ""), "given": ("leaderboard", "EVALUATE.md", r" method\.py")}


def read_template(merge: Literal["own", "given"]) -> str:
    """Return a whole method that `evaluate` can call: it merges by the package, or is given the merge."""
    folder, page, title = _PAGES[merge]
    text = (resources.files("eval") / folder / page).read_text(encoding="utf-8")
    found = re.search(rf"^```python{title}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert found is not None, page  # a test runs both
    return found[1]


def write_template(path: Path, merge: Literal["own", "given"]) -> None:
    """Write a template.

    Raises:
        InputError: The file exists, or cannot be written.
    """
    with new_files(path) as partial:
        (partial / path.name).write_text(read_template(merge), encoding="utf-8")
