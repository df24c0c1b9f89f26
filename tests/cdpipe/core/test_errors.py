"""Text of errors and warnings: names from files cannot break a line or move the cursor."""

from __future__ import annotations

import pickle
import warnings

import pytest

from cdpipe.core.errors import InputError, InputWarning, MergeFailedError, ScenarioError


@pytest.mark.parametrize("kind", [InputError, ScenarioError, InputWarning])
def test_what_is_not_shown_is_escaped_and_lines_stay(kind: type[Exception]) -> None:
    error = kind("a.csv: names x\x0cy, \x1b[2J, \u202etxt and Gr\u00fc\u00dfe:\n  second line")
    assert str(error) == "a.csv: names x\\x0cy, \\x1b[2J, \\u202etxt and Gr\u00fc\u00dfe:\n  second line"
    assert str(kind(str(error))) == str(error) == str(pickle.loads(pickle.dumps(error)))


def test_a_refused_merge_and_a_warning_too() -> None:
    assert str(MergeFailedError("no\x07 overlap", {"overlap": 0.1})) == "no\\x07 overlap"
    with pytest.warns(InputWarning, match=r"^x\\x85y$"):
        warnings.warn("x\x85y", InputWarning, stacklevel=1)
