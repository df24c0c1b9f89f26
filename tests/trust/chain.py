"""From a scenario to scores and weights by the command line: what `test_same_bytes.py` runs in different places.

Every command runs in the working folder; what `score` prints goes to `row.txt`, its times left out.

    python tests/trust/chain.py SCENARIO.yaml
"""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout
from pathlib import Path

from eval.cli.main import main


def tunnelcd(*argv: str) -> str:
    """Run a command as the command line does, and return what it prints."""
    sys.argv = ["tunnelcd", *argv]
    printed = io.StringIO()
    try:
        with redirect_stdout(printed):
            main()
    except SystemExit as error:
        if error.code:
            raise
    return printed.getvalue()


def run_chain(scenario: str) -> None:
    tunnelcd("simulate", scenario, "--seed", "20000", "--out", "pair", "--quiet")
    tunnelcd("detect", "pair/before", "pair/after", "--out", "answer", "--quiet")
    rows = tunnelcd("score", "pair", "answer").splitlines()
    Path("row.txt").write_text("".join(f"{row}\n" for row in rows if not row.startswith("t_")), encoding="utf-8")
    # one tunnel to train on, one to validate with
    tunnelcd("dataset", scenario, "--seeds", "9999:10001", "--draws", "1", "--out", "data", "--quiet")
    tunnelcd("train", "data", "--out", "sphere", "--steps", "2", "--threads", "1", "--quiet")
    tunnelcd("train", "data", "--out", "place", "--descriptor", "3deg", "--steps", "1", "--quiet")
    tunnelcd("train", "data", "--out", "net", "--descriptor", "range-net", "--steps", "1", "--threads", "1", "--quiet")


if __name__ == "__main__":
    run_chain(sys.argv[1])
