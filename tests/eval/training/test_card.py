import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cdpipe.training.shard import FIELDS, encode_shard
from eval.core.provenance import digest_file
from eval.release.archive import read_sums
from eval.training.dataset_card import COUNTS, INDEX_COLUMNS, card, write_card


def test_names_do_not_leave_their_place_in_the_card() -> None:
    bad = "a|b\n# c <img src=x> `d`"
    row = {"family": bad, "seed": 1, "status": "refused", "reason": bad}
    made = {"family": bad, "seed": 2, "status": "ok", "split": "train", "shard": "s", "sha256": "0", "bytes": 1}
    made |= dict.fromkeys(("n_before", "n_covered", "n_positive", "n_negative", "n_changes", "n_observable"), 1)
    text = card([row, made], {"settings": [], "draws": 1, "error_m": 0.0, "error_deg": 0.0}, [])
    assert "<img" not in text
    shown = r"a\|b\n# c &lt;img src=x> \`d\`"
    assert text.count(shown) == 4 and "\n# c" not in text


def test_metadata_of_shards_are_valid_and_list_refused_tunnels(tmp_path: Path) -> None:
    about = {"family": "a", "seed": 3, "digest": "d", "score_radius_m": 4.5, "counts": dict.fromkeys(COUNTS, 1)}
    arrays = {
        each.name: np.ones([int(n) if n.isdigit() else 1 for n in each.shape.split(",")], each.dtype) for each in FIELDS
    }
    (tmp_path / "a-3.safetensors").write_bytes(encode_shard(arrays, about))
    refused = {"family": "b", "seed": 4, "digest": "d", "reason": "no way, nowhere"}
    (tmp_path / "b-4.safetensors.refused.json").write_text(json.dumps(refused))
    recipe = {"settings": [], "draws": 1, "error_m": 0.0, "error_deg": 0.0}
    (tmp_path / "dataset.json").write_text(json.dumps({"recipe": recipe, "commands": ["tunnelcd dataset"]}))
    write_card(tmp_path)
    sums = read_sums(tmp_path)
    assert set(sums) == {"README.md", "a-3.safetensors", "croissant.json", "dataset.json", "index.csv"}
    assert all(sums[name] == digest_file(tmp_path / name) for name in sums)
    document = json.loads((tmp_path / "croissant.json").read_text())
    assert [field["name"] for field in document["recordSet"][0]["field"]] == list(INDEX_COLUMNS)
    pytest.importorskip("mlcroissant", reason="pip install 'tunnelcd[croissant]'")
    program = (
        "import mlcroissant, sys\n"
        "data = mlcroissant.Dataset(sys.argv[1])\n"
        "assert not data.metadata.issues.errors, data.metadata.issues.report()\n"
        "for row in data.records('index'): print(row['index/seed'], row['index/n_before'])\n"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "croissant.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()[0].split()[0]) == (0, "3"), done.stderr
    assert len(done.stdout.splitlines()) == 2


def test_data_with_recordings_are_not_given_away_as_simulated() -> None:
    row = {"family": "a", "seed": 2, "status": "ok", "split": "train", "shard": "s", "sha256": "0", "bytes": 1}
    row |= dict.fromkeys(("n_before", "n_covered", "n_positive", "n_negative", "n_changes", "n_observable"), 1)
    recipe = {"settings": [], "draws": 1, "error_m": 0.0, "error_deg": 0.0}
    assert "| licence | MIT, as tunnelcd itself: everything is simulated" in card([row], recipe, [])
    told = card([row, {**row, "is_recorded": True}], recipe, [])
    assert "| licence | that of the recordings" in told and "everything is simulated" not in told
