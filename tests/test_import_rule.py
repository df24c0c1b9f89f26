"""`import eval` shadows the builtin in the module that does it; `from eval.x import y` does not."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [path for top in ("cdpipe", "scenarios", "sim", "eval", "tests") for path in sorted((ROOT / top).rglob("*.py"))]


def imports_eval(source: str) -> bool:
    return any(
        isinstance(node, ast.Import)
        and any((alias.asname or alias.name.split(".")[0]) == "eval" for alias in node.names)
        for node in ast.walk(ast.parse(source))
    )


def test_the_rule_sees_what_it_should() -> None:
    assert imports_eval("import eval.scoring.scoring")
    assert not imports_eval("from eval.scoring.scoring import score_stored\nimport evaluate")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_imports_eval_by_its_bare_name(path: Path) -> None:
    assert not imports_eval(path.read_text())


def test_tests_are_no_package() -> None:
    assert list((ROOT / "tests").rglob("__init__.py")) == []
