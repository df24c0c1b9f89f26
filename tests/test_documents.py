"""Every Markdown page: its links, paths, modules and commands exist, and pages stay short."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
import typer.main
import yaml

from eval.cli.main import app

ROOT = Path(__file__).parents[1]
PACKAGES = ("cdpipe", "eval", "scenarios", "sim")
PAGES = sorted(path for folder in (*PACKAGES, "reports") for path in (ROOT / folder).rglob("*.md")) + sorted(
    ROOT.glob("*.md")
)
MODULES = {path.name for folder in (*PACKAGES, "tests") for path in (ROOT / folder).rglob("*.py")}
COMMANDS = typer.main.get_command(app).commands
WORDS = {"README.md": 1200, "cdpipe/GLOSSARY.md": 800, **{f"{package}/README.md": 1500 for package in PACKAGES}}
PATH = re.compile(r"[\w.-]+(?:/[\w.-]+)*(?:/|\.(?:py|yaml|md|json|toml|png|csv|cff))")
# what a run makes, and what stands for a name of the reader's
OTHERS = re.compile(
    r"^(out|pair|pairs|answer|cells|maps|stages|views|answers|truth|RUN|PAIR|DIR|OUT|presets|plans|families|props|tunnelcd_\w+)/|NAME|<"
)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        linked = (page.parent / name).resolve() if name else page
        assert linked.exists(), target
        if anchor:
            assert anchor in anchors(linked), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_path_module_and_command_exists(page: Path) -> None:
    text = page.read_text()
    quoted = re.findall(r"`([^`\n]+)`", text)
    package = page.relative_to(ROOT).parts[0]
    places = (page.parent, ROOT, ROOT / package, ROOT / "tests")
    for word in quoted:
        if PATH.fullmatch(word) and "/" in word and not OTHERS.search(word):
            assert any((place / word).exists() for place in places), word
        elif re.fullmatch(r"\w+\.py", word) and package != "reports":
            assert word in MODULES or word.startswith(("predict.", "tunnelcd_")), word  # files of the reader
    for module in re.findall(r"python -m ([\w.]+)", text):
        assert module in {"venv"} or importlib.util.find_spec(module) is not None, module
    targets = re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for target in re.findall(r"(?:^|`)make ([a-z][\w-]*)", text, re.MULTILINE):
        assert target in targets, target
    for command in re.findall(r"^tunnelcd ([\w-]+)", text, re.MULTILINE) + [
        word.split()[1] for word in quoted if re.match(r"tunnelcd [a-z]+\b", word)
    ]:
        assert command in COMMANDS, command


@pytest.mark.parametrize(("name", "most"), WORDS.items())
def test_pages_that_are_read_first_stay_short(name: str, most: int) -> None:
    assert len((ROOT / name).read_text().split()) <= most


def test_long_options_of_the_commands_in_blocks_exist() -> None:
    for page in PAGES:
        for block in re.findall(r"^```[^\n]*\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            for line in block.splitlines():
                found = re.match(r"tunnelcd ([\w-]+) ([^#]*)", line)
                if found is None or found[1] not in COMMANDS:
                    continue
                known = {name for option in COMMANDS[found[1]].params for name in option.opts}
                assert set(re.findall(r"--[A-Za-z-]+", found[2])) <= known, (page, line)


def test_the_citation_names_the_paper_and_this_version() -> None:
    document = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert document["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    paper = document["preferred-citation"]
    assert paper["identifiers"][0]["value"] == "arXiv:2306.15416"
    readme = (ROOT / "README.md").read_text()
    assert paper["title"] in readme
    assert all(author["family-names"] in readme for author in paper["authors"])


@pytest.mark.parametrize("package", ["cdpipe", "eval", "sim"])
def test_the_table_of_folders_has_the_order_of_the_import_contract(package: str) -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = [each["layers"] for each in contracts if each.get("containers") == [package]]
    text = (ROOT / package / "README.md").read_text()
    table = text.partition("## Folders")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = [[name.removesuffix(".py").rstrip("/") for name in re.findall(r"`([^`]+)`", row)] for row in rows]
    level = {name: index for index, layer in enumerate(layers) for name in layer.split(" | ")}
    listed = [name for row in named for name in row]
    assert sorted(listed) == sorted(level)
    assert [level[name] for name in listed] == sorted(level.values())


def test_names_in_the_pages_of_the_packages_are_names_of_the_code() -> None:
    files = [path for folder in (*PACKAGES, "tests") for path in (ROOT / folder).rglob("*") if path.is_file()]
    sources = "\n".join(path.read_text() for path in files if path.suffix in {".py", ".pyi", ".yaml", ".html"})
    sources += "\n".join(path.stem for path in files)
    of_others = {"save_trajectory", "regions__narrow", "tunnelcd_higher", "tunnelcd_largest"}
    for page in PAGES:
        if page.is_relative_to(ROOT / "reports") or page.name == "CHANGELOG.md":
            continue  # notes and entries of their day
        for quoted in re.findall(r"`([^`\n]+)`", page.read_text()):
            for name in re.findall(r"[A-Za-z]\w*_\w+|[A-Z][a-z]+[A-Z]\w+", quoted):
                assert name in sources or name in of_others, (page, name)
