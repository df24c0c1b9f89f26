"""The page in a browser without a network: charts are drawn, nothing is complained of; and its size at 2,000 rows."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.report.page import write_page
from eval.running.runfolder import write_json

METHODS = (
    "paper", "paper-topn", "paper-paired", "tunnelcd", "scan-context", "solid", "random-regions", "voxel-diff", "c2c",
    "dufomap",
)  # fmt: skip
SCENARIOS = [f"{group}/{kind}" for group in "abcd" for kind in ("narrow", "wide", "network", "cave", "site1")]
N_SEEDS = 10
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
OFFLINE = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr",
    "--v=0", "--virtual-time-budget=20000", "--window-size=1280,900",
)  # fmt: skip
MAX_BYTES = 1_000_000


def write_large_run(folder: Path) -> Path:
    """Write the tables of 20 scenarios, 10 seeds and 10 methods, with a grid beside them."""
    folder.mkdir()
    draw = np.random.default_rng(0)
    names = [(world, seed, name) for world in SCENARIOS for seed in range(N_SEEDS) for name in METHODS]
    results = pd.DataFrame(names, columns=["scenario", "seed", "variant"])
    skill = results["variant"].map({name: 0.1 * place for place, name in enumerate(METHODS)}).to_numpy()
    share = {
        key: np.clip(skill + draw.normal(0, 0.1, len(results)), 0, 1)
        for key in ("region_recall", "region_precision", "region_recall_at_k", "region_auroc", "object_iou_point",
                    "object_f1_50", "kind_accuracy")
    }  # fmt: skip
    results = results.assign(
        family=results["scenario"], status="ok", error="", is_unchanged_pair=False, is_alarm=np.nan, n_changes=4,
        n_observable=4, after_path_m=200.0, score_radius_m=4.5, false_regions_per_100m=0.2, merge_error_m=0.01,
        merge_error_deg=0.02, t_total_s=draw.gamma(3, 0.5, len(results)), bytes_regions_before=4e4, **share,
    )  # fmt: skip
    grid = [
        {**results.iloc[0].to_dict(), "variant": f"tunnelcd[extract.voxel_m={a},query.radius_m={b}]",
         "object_iou_point": 0.1 * a + 0.01 * b}
        for a in range(1, 4) for b in range(1, 5)
    ]  # fmt: skip
    pd.concat([results, pd.DataFrame(grid)]).to_csv(folder / "results.csv", index=False)
    curve = np.linspace(0, 1, 300)
    for file, columns in (("roc", ("false_positive_rate", "true_positive_rate")),
                          ("froc", ("false_regions_per_100m", "recall"))):  # fmt: skip
        parts = [
            pd.DataFrame({"domain": domain, "variant": name, columns[0]: curve, columns[1]: curve ** (1 / (1 + place))})
            for domain in ("in", "out") for place, name in enumerate(METHODS)
        ]  # fmt: skip
        pd.concat(parts).to_csv(folder / f"{file}.csv", index=False)
    n_pairs = len(SCENARIOS) * N_SEEDS
    table = [
        {"domain": domain, "variant": name, "n_pairs": n_pairs, "n_failed": 0, "n_observable": 400, "n_found": 100,
         "false_regions_per_100m": 0.2, "region_auroc_pooled": 0.5, "n_unchanged": 0, "recall_at_0.1": 0.5,
         "recall_at_0.1_low": 0.4, "recall_at_0.1_high": 0.6, "recall_at_0.1_proposed": 0.4}
        for domain in ("in", "out") for name in METHODS
    ]  # fmt: skip
    missing = {"region_auroc": 0.5, "region_recall_at_k": 0.5, "recall_at_0.5": 0.5, "region_recall": 0.5,
               "region_precision": 0.5, "bytes_ratio": 1.0, "t_descriptor_per_keyframe_s": 0.01,
               "t_cd_per_region_s": 0.01, "km_unchanged": 0.0}  # fmt: skip
    pd.DataFrame(table).assign(**missing).to_csv(folder / "regions_table.csv", index=False)
    write_json(
        folder / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "main", "report": ["regions", "objects"]}}
    )
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(write_large_run(tmp_path_factory.mktemp("large") / "run"))


def opened(page: Path, profile: Path, *options: str) -> tuple[str, str]:
    """Open a page without a network; return what the browser prints and what it complains of."""
    command = [str(BROWSER), *OFFLINE, f"--user-data-dir={profile}", *options, page.as_uri()]
    done = subprocess.run(command, capture_output=True, timeout=300, check=True)
    log = done.stderr.decode("utf-8", "replace").splitlines()
    return done.stdout.decode("utf-8", "replace"), "\n".join(line for line in log if "CONSOLE" in line)


def test_a_page_of_two_thousand_rows_is_light(page: Path) -> None:
    text = page.read_text()
    assert len(text.encode()) < MAX_BYTES
    assert text.count("<script>") == 1


def test_the_first_table_of_such_a_page_ranks_the_methods(page: Path) -> None:
    table = page.read_text().partition('id="summary"')[2].partition("</table>")[0]
    ranked = re.findall(r"<tr><td><a[^>]*>([^<]*)</a></td>", table)
    assert ranked[:3] == ["dufomap", "c2c", "voxel-diff"]
    assert "tunnelcd" in ranked, "the method that the plan is about is shown whatever its place"
    assert re.search(r'dufomap</a></td>.*?class="best">0\.90<small>', table)


def test_every_chart_is_drawn_without_a_script(page: Path) -> None:
    charts = re.split(r'class="chart" id="', page.read_text())[1:]
    assert len(charts) == 6
    for chart in charts:
        assert 'class="plot"' in chart.partition("</figure>")[0]
    # lines of all ten methods in both panels of the free-response curve
    curves = chart_of(charts, "free_response")
    assert curves.count('class="plot"') == 2
    assert curves.count('class="line"') >= 2 * len(METHODS)


@needs_browser
def test_the_scripts_run_offline_and_nothing_is_complained_of(page: Path, tmp_path: Path) -> None:
    shown, complaints = opened(page, tmp_path, "--dump-dom")
    assert complaints == ""
    assert shown.count('class="filter"') >= 2
    assert re.search(r'<th scope="col" data-term="c\d+"><button type="button" aria-describedby="c\d+-1">', shown)
    assert "aria-pressed" in chart_of(re.split(r'class="chart" id="', shown)[1:], "roc")


def chart_of(charts: list[str], name: str) -> str:
    return next(chart for chart in charts if chart.startswith(f'{name}"')).partition("</figure>")[0]


@needs_browser
def test_it_can_be_printed(page: Path, tmp_path: Path) -> None:
    paper = tmp_path / "page.pdf"
    _, complaints = opened(page, tmp_path / "profile", f"--print-to-pdf={paper}")
    assert complaints == ""
    assert paper.read_bytes().startswith(b"%PDF")
    assert paper.stat().st_size > 100_000
