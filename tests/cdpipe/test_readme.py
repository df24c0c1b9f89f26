from __future__ import annotations

from pathlib import Path

from cdpipe.model.config import settings_table

CDPIPE = Path(__file__).parents[2] / "cdpipe"


def test_the_table_of_settings_is_the_one_of_the_code() -> None:
    rows = [f"| `{key}` | {default} | {meaning} |" for key, default, meaning in settings_table()]
    text = (CDPIPE / "SETTINGS.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("| `")] == rows


def test_the_table_of_folders_is_complete() -> None:
    text = (CDPIPE / "README.md").read_text()
    section = text[text.index("## Folders") : text.index("## Stages")]
    named = {line.split("`")[1].rstrip("/") for line in section.splitlines() if line.startswith("| `")}
    assert named == {"pipeline.py"} | {path.parent.name for path in CDPIPE.glob("*/__init__.py")}
