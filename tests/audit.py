"""Licences of all installed packages, and known vulnerabilities among the pinned ones (`make audit`).

python tests/audit.py PYTHON        # the environment of that interpreter; needs pip-licenses, pip-audit and a network

The exit code is 1 if a licence is not accepted, if a pin has a known vulnerability, or if not all pins could be looked
up.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
# Each part of a licence must contain one of these: they allow use and distribution beside other code. MPL asks for
# the sources of its own files alone, which we do not change.
PERMISSIVE = (
    "0BSD", "Apache", "BSD", "BSL-1.0", "CC0-1.0", "CNRI-Python", "ISC", "MIT", "MPL-2.0", "Mozilla Public License 2.0",
    "PSF", "Python Software Foundation", "Zlib",
)  # fmt: skip
ACCEPTED = {
    "embreex": "its field holds the text of the BSD licence with two clauses",
    "mlcroissant": "Apache-2.0 in its repository, while its metadata name none; tests and the extra `croissant` alone",
    "pyoctomap": "its field holds the text of the MIT licence; the extra `octomap` alone",
    "ouster_sdk": "BSD-3-Clause, and in its wheel parts under the vendor's freeware licence; the extra `ouster` alone",
    "zeroconf": "LGPL, an unchanged library that the vendor's SDK requires; the extra `ouster` alone",
}


def judge_licence(package: str, licence: str) -> str:
    """Return why a licence is accepted, or "" if it is not."""
    if package in ACCEPTED:
        return ACCEPTED[package]
    parts = re.split(r"\s+(?:AND|OR)\s+|;", licence)
    return "permissive" if all(any(name in part for name in PERMISSIVE) for part in parts) else ""


def list_licences(rows: Iterable[Mapping[str, str]]) -> tuple[list[str], list[str]]:
    """Return the lines of the table of licences, and one line for each that is not accepted."""
    table, refused = [], []
    for row in sorted(rows, key=lambda row: row["Name"].lower()):
        name, licence = row["Name"], row["License"].partition("\n")[0]
        reason = judge_licence(name, row["License"])
        table.append(f"| {name} | {row['Version']} | {licence} | {reason or 'not accepted'} |")
        if not reason:
            refused.append(
                f"{name} {row['Version']}: {licence}: accept it with a reason in tests/audit.py, or do without"
            )
    return table, refused


def list_vulnerabilities(dependencies: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str]]:
    """Return the lines about known vulnerabilities, and one line for each fault."""
    looked_up = [each for each in dependencies if "skip_reason" not in each]
    told = [
        f"{each['name']} {each['version']}: {found['id']}, mended in {', '.join(found['fix_versions']) or 'no version'}"
        for each in looked_up
        for found in each["vulns"]
    ]
    summary = f"{len(looked_up)} of {len(dependencies)} pins looked up, {len(told)} known vulnerabilities"
    n_missed = len(dependencies) - len(looked_up)
    missed = [f"{n_missed} pins could not be looked up: is the network there?"] if n_missed or not dependencies else []
    return [summary], [*told, *missed]


def main(python: str) -> int:
    """Print both lists, and the faults on standard error."""
    licences = _call("piplicenses", f"--python={python}", "--with-system", "--format=json")
    table, faults = list_licences(json.loads(licences))
    lines = ["| package | version | licence | accepted |", "|---|---|---|---|", *table, ""]
    options = ("--no-deps", "--disable-pip", "--progress-spinner=off", "--format=json")
    found = _call("pip_audit", "--requirement", str(ROOT / "constraints.txt"), *options)
    try:
        told, more = list_vulnerabilities(json.loads(found)["dependencies"])
    except json.JSONDecodeError:  # it ends with a traceback where there is no network
        told, more = [], ["known vulnerabilities were not looked up: pip-audit did not reach its service"]
    sys.stdout.write("\n".join([*lines, *told, ""]))
    sys.stderr.write("".join(f"error: {line}\n" for line in [*faults, *more]))
    return int(bool(faults or more))


def _call(module: str, *options: str) -> str:
    # pip-audit exits with 1 where it finds something, and its list is on standard output all the same
    argv = [sys.executable, "-P", "-m", module, *options]
    return subprocess.run(argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False).stdout


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
