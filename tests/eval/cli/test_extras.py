from collections.abc import Callable
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METHODS, entry_points
from cdpipe.methods.registry import load_method
from cdpipe.pipeline import mapping

Command = Callable[..., tuple[int, str, str]]
EXTRAS = {"m3c2": "m3c2", "m3c2-ep": "m3c2", "dufomap": "dufomap", "octomap": "octomap"}


@pytest.mark.parametrize("method", EXTRAS)
def test_a_missing_extra_is_named_before_anything_is_mapped(
    method: str, tiny_pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    monkeypatch.delattr(mapping, "build_map")
    folders = (tiny_pair / "before", tiny_pair / "after", "--preset", method, "--out", tmp_path / "out")
    code, out, err = command("detect", *folders)
    assert code == 2
    assert f"regions.source = {method} needs a package more: pip install 'tunnelcd[{EXTRAS[method]}]'" in err
    assert not (tmp_path / "out").exists()
    assert out == ""
    for name in entry_points(METHODS).keys() - EXTRAS.keys():
        load_method(name)
    with pytest.raises(InputError, match=rf"pip install 'tunnelcd\[{EXTRAS[method]}\]'"):
        load_method(method)


def test_a_missing_extra_of_a_rival_of_displacement_is_named_before_anything_is_mapped(
    tiny_pair: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpipe.core.plugins.find_spec", lambda name: None)
    monkeypatch.delattr(mapping, "build_map")
    given = ("--set", "surface.method=m3c2-ep", "--out", tmp_path / "out")
    code, out, err = command("detect", tiny_pair / "before", tiny_pair / "after", *given)
    assert code == 2
    assert "surface.method = m3c2-ep needs a package more: pip install 'tunnelcd[m3c2]'" in err
    assert not (tmp_path / "out").exists()
    assert out == ""
