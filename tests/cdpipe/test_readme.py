from __future__ import annotations

from pathlib import Path

from cdpipe.model.config import settings_table


def test_the_table_of_settings_is_the_one_of_the_code() -> None:
    rows = [f"| `{key}` | {default} | {meaning} |" for key, default, meaning in settings_table()]
    text = (Path(__file__).parents[2] / "cdpipe" / "SETTINGS.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("| `")] == rows
