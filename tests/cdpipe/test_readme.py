from __future__ import annotations

from pathlib import Path

from cdpipe.model.config import settings_table

README = Path(__file__).parents[2] / "cdpipe" / "README.md"


def test_the_table_of_settings_is_the_one_of_the_code() -> None:
    rows = [f"| `{key}` | {default} | {meaning} |" for key, default, meaning in settings_table()]
    text = README.read_text()
    settings = text[text.index("## Settings") : text.index("## Your own recordings")]
    written = [line for line in settings.splitlines() if line.startswith("| `")]
    assert written == rows


def test_every_file_it_names_exists() -> None:
    text = README.read_text()
    stages = text[text.index("## Stages") : text.index("## Holes")]
    named = [word for line in stages.splitlines() for word in line.split("`")[1::2] if word.endswith((".py", "/"))]
    assert len(named) > 12
    assert all((README.parent / name).exists() for name in named)
