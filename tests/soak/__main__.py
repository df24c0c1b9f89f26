"""Kills commands, workers and schedulers at random moments, fills a disk and closes a folder: nothing may be lost.

A plan of many cheap cells runs undisturbed once. Then it runs again and again, each time under one kind of
disturbance, with rising and falling numbers of workers, and until it ends. Every row, answer and table of its page must
be that of the undisturbed run, times apart. The other commands that write are killed and run again alike. The moments
come from a seed. Exit code 1 where anything differs. Linux.

    python -m tests.soak --minutes 30 --out FOLDER        # what `make soak` does; the table is FOLDER/soak.md
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import sys
from pathlib import Path

from cdpipe.core.threads import fix_threads

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0, help="after these no further round begins")
    parser.add_argument("--out", type=Path, required=True, help="new or empty folder")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=4, help="seeds of the plan, eight cells each")
    parser.add_argument("--only", action="append", default=[], metavar="ROW", help="of the table; may be repeated")
    options = parser.parse_args()
    fix_threads()
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    temporary = options.out.absolute() / "tmp"  # of clients that are killed before they remove theirs
    temporary.mkdir(parents=True)
    os.environ["TMPDIR"] = str(temporary)
    from tests.soak.soak import COMMANDS, RUNS, Size, Soak, disks

    soak = Soak(options.out, random.Random(options.seed), Size(n_seeds=options.seeds))
    soak.run_undisturbed()
    every = [name for name in (*RUNS, *COMMANDS, *disks()) if not options.only or name in options.only]
    for number, name in enumerate(itertools.cycle(every)):
        if soak.seconds() > 60 * options.minutes:
            break
        if number >= len(every) and name in disks():
            continue  # once is enough
        soak.disturb(name)
    table = soak.table()
    (options.out / "soak.md").write_text(table, encoding="utf-8")
    sys.stdout.write(table)
    sys.exit(not soak.is_clean())
