from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.cli.tools import check_file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tunel: {}\nbefore: {route: [a, b]}\nafter: {route: [a, b]}\n", 'did you mean "tunnel"'),
        ("name: x\nscenario: [smoke/one_box]\nseeds: '0:1'\nvariants: [{preset: paper}]\n", 'did you mean "scenarios"'),
        ("qery: {radius_m: 4}\n", 'did you mean "query"'),
    ],
)
def test_a_misspelt_key_does_not_change_what_a_file_is(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        check_file(str(path))
    assert said in str(caught.value)


@pytest.mark.parametrize(("name", "kind"), [("smoke", "plan"), ("narrow", "scenario"), ("paper-topn", "preset")])
def test_shipped_names_are_known(name: str, kind: str) -> None:
    assert f"a {kind}" in check_file(name)
