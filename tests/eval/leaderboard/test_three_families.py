"""As a new user: the documented scripts on three families, from the command line to the page.

The template on family `smoke` is in tests/eval/running/test_predictions.py.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

Command = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[3]
HERE = Path(__file__).parent
SMALL = {"name": "smoke/one_box", "set": ["sensor.mode=512x10", "platform.scan_spacing_m=1.0"]}
FAMILIES = [str(HERE / "narrow.yaml"), str(HERE / "cave.yaml")]


def test_the_documented_scripts_get_from_a_plan_to_the_page(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert command("template", "method.py", "--merge", "given")[0] == 0
    assert command("template", "predict.py", "-q") == (0, "", "")
    for name, families in (("one", [SMALL]), ("two", FAMILIES)):
        text = f"name: {name}\nscenarios: {families}\nseeds: [10600]\nvariants: [{{preset: tunnelcd}}]\n"
        Path(f"{name}.yaml").write_text(text)
    told = f"{sys.executable} method.py {{before}} {{after}} {{out}} {{merge}}"
    given = ("--merge", "given", "--as", "told")
    code, out, err = command("evaluate", "--plan", "one.yaml", "--out", "bench", "--command", told, *given)
    assert code == 0, err
    assert "1/1" in out and max(map(len, out.splitlines())) <= 80
    own = f"{sys.executable} predict.py {{before}} {{after}} {{out}}"
    assert (
        command("evaluate", "--plan", "two.yaml", "--out", "bench", "--command", own, "--as", "template", "-q")[0] == 0
    )
    rows = pd.read_csv("bench/results.csv")
    assert rows["variant"].tolist().count("template") == 2 and set(rows["status"]) == {"ok"}
    assert rows["merge_error_m"].max() < 0.1  # driven back, a registration from the identity is 14 m off
    assert rows["region_recall"].min() == 1.0 and rows["false_regions_per_100m"].max() == 0.0
    assert rows["object_iou_point"].min() > 0.4
    differences = pd.read_csv("bench/evaluations/template/differences.csv")
    assert set(differences["scenario"]) == set(FAMILIES) and differences["region_recall"].tolist() == [1.0, 1.0]
    for name in ("told", "template"):
        assert command("submit", "bench", "--as", name, "--out", f"{name}.zip")[0] == 0
    code, _, err = command("leaderboard", "told.zip", "template.zip", "--out", "board.html")
    assert code == 0, err
    page = Path("board.html").read_text()
    told = "1 pair, seed 10600 of no test split<"  # a seed for validation
    assert f"Plan two, in distribution, {told}" in page and f"Plan two, out of distribution, {told}" in page
    assert f"Plan one, {told}" in page
