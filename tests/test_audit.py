"""`make audit` refuses what nobody has accepted, and does not take silence for a clean bill."""

from typing import Any

import pytest

from tests.audit import ACCEPTED, judge_licence, list_licences, list_vulnerabilities


@pytest.mark.parametrize(
    ("licence", "is_accepted"),
    [
        ("MIT License", True),
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", True),
        ("MIT; BSD License", True),
        ("UNKNOWN", False),
        ("", False),
        ("GNU General Public License v3 (GPLv3)", False),
        ("LGPL-2.1-or-later", False),
        ("MIT AND GPL-3.0-only", False),
        ("MIT; GNU Affero General Public License v3", False),
    ],
)
def test_a_licence_is_accepted_if_each_part_of_it_is(licence: str, is_accepted: bool) -> None:
    assert bool(judge_licence("some", licence)) == is_accepted


def test_every_package_is_a_row_and_a_refused_one_an_error() -> None:
    rows = [
        {"Name": "b", "Version": "2", "License": "GPL-3.0-only"},
        {"Name": "A", "Version": "1", "License": "MIT"},
        {"Name": next(iter(ACCEPTED)), "Version": "3", "License": "all rights\nreserved"},
    ]
    table, refused = list_licences(rows)
    assert [line.split(" | ")[0] for line in table] == ["| A", "| b", f"| {next(iter(ACCEPTED))}"]
    assert [line.partition(":")[0] for line in refused] == ["b 2"]


@pytest.mark.parametrize(
    ("dependencies", "n_faults"),
    [
        ([{"name": "a", "version": "1", "vulns": []}], 0),
        ([{"name": "a", "version": "1", "vulns": [{"id": "CVE-1", "fix_versions": ["2"]}]}], 1),
        ([{"name": "a", "version": "1", "vulns": []}, {"name": "b", "skip_reason": "not found"}], 1),
        ([], 1),
    ],
)
def test_what_was_not_looked_up_is_no_good_news(dependencies: list[dict[str, Any]], n_faults: int) -> None:
    told, faults = list_vulnerabilities(dependencies)
    assert len(told) == 1 and len(faults) == n_faults
