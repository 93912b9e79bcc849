"""Commands, Python code and links in the README and the guides are valid.

Blocks marked `sh` and `python` run. Blocks marked `bash` are only parsed: their commands take long, need an optional
package or wait for a user.
"""

import os
import re
import shlex
import warnings
from importlib import import_module
from pathlib import Path

import pytest
import typer.testing
from typer.testing import CliRunner

import rig
from rig.core.scene.scene_files import bundled_scenes
from rig.core.scene.yaml_reader import read_yaml

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("*/guide/*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
PROGRAMS = ("rig", "daq", "analysis")


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return kind and text of the code blocks of a page."""
    return re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def commands(page: Path, *kinds: str) -> list[list[str]]:
    """Return the words of each command of this product in blocks of some kinds."""
    lines = [
        shlex.split(line, comments=True)
        for kind, block in blocks(page)
        if kind in kinds
        # A backslash continues a command on the next line.
        for line in block.replace("\\\n", " ").splitlines()
    ]
    return [words for words in lines if words and words[0] in PROGRAMS]


def new_commands(page: Path) -> list[list[str]]:
    """Return the commands in `sh` blocks of a page that no earlier page contains."""
    earlier = [words for other in PAGES[: PAGES.index(page)] for words in commands(other, "sh")]
    return [words for words in commands(page, "sh") if words not in earlier]


def scenes() -> dict[str, str]:
    """Return the texts of the scene files that readers of the pages save, by name."""
    scene_texts = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name, block in re.findall(r"[Ss]ave this as `(\w+\.yaml)`:\n\n```yaml\n(.*?)^```", text, re.S | re.M):
            scene_texts[name] = block
    return scene_texts


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the repository's recordings and the scenes of all pages."""
    (tmp_path / "recordings").mkdir()
    for file in (ROOT / "recordings").glob("*.mcap"):
        os.link(file, tmp_path / "recordings" / file.name)
    for name, block in scenes().items():
        (tmp_path / name).write_text(block, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


@pytest.mark.thorough
@pytest.mark.parametrize("page", [page for page in PAGES if new_commands(page)], ids=lambda page: page.stem)
def test_commands_of_pages_run_as_typed(page, folder) -> None:
    for words in new_commands(page):
        with warnings.catch_warnings():
            # A few coarse steps do not settle, and the recording reports it.
            warnings.simplefilter("ignore")
            result = CliRunner().invoke(import_module(f"{words[0]}.commands.cli").app, words[1:])
        assert result.exit_code == 0, (words, result.output, result.exception)
        assert result.output, words


@pytest.mark.thorough
def test_readme_quotes_printed_comparison(folder) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (words,) = [words for words in commands(ROOT / "README.md", "sh") if words[1] == "compare"]
    quoted = re.findall(r"^    ((?:response|body3) .*)$", text, re.MULTILINE)
    printed = CliRunner().invoke(import_module("analysis.commands.cli").app, words[1:]).output
    assert len(quoted) == 3 and all(line in printed for line in quoted)


@pytest.mark.thorough
@pytest.mark.parametrize("page", [page for page in PAGES if "python" in dict(blocks(page))], ids=lambda page: page.stem)
def test_python_of_pages_runs(page, folder) -> None:
    namespace: dict[str, object] = {}  # shared by the blocks of a page
    for kind, block in blocks(page):
        if kind == "python":
            exec(compile(block, str(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_of_pages_have_existing_options(page, folder) -> None:
    (folder / "your_script.py").touch()
    for words in commands(page, "sh", "bash"):
        command = typer.testing._get_command(import_module(f"{words[0]}.commands.cli").app).commands[words[1]]
        command.make_context(words[1], words[2:])
        for word in words[2:]:
            assert word not in (*scenes(), *bundled_scenes()) or rig.load(word)


def test_each_test_line_of_guide_is_valid(folder) -> None:
    lines = [
        line
        for kind, block in blocks(ROOT / "daq" / "guide" / "choose-a-test.md")
        if kind == "yaml"
        for line in block.splitlines()
    ]
    assert len(lines) >= 10
    for line in lines:
        kind = re.search(r"kind: (\w+)", line)
        assert (
            kind is not None and rig.load("mine.yaml", {"test": read_yaml(line).content["test"]}).test.kind == kind[1]
        )


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_of_pages_lead_somewhere(page) -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
    assert all((page.parent / link).exists() for link in links), links


def test_site_contains_each_guide_page() -> None:
    contents = (ROOT / ".docs/index.md").read_text(encoding="utf-8").split()
    pages = {str(page.relative_to(ROOT).with_suffix("")) for page in ROOT.glob("*/guide/*.md") if page.stem != "index"}
    assert pages - set(contents) == set()


def glossary() -> list[list[str]]:
    """Return the cells of the rows of the glossary, without headings."""
    text = (ROOT / "rig/guide/glossary.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return [row for row in rows if row[0] != "term" and not row[0].startswith("---")]


def product_text() -> str:
    """Return documents and code of the product without the glossary, in lower case."""
    files = [*PAGES, *ROOT.glob("*/README.md"), *(f for name in PROGRAMS for f in (ROOT / name).rglob("*.py"))]
    return "\n".join(f.read_text(encoding="utf-8").lower() for f in files if f.name != "glossary.md")


def test_each_term_of_glossary_is_used() -> None:
    text = product_text()
    terms = [term.strip(" *").lower() for row in glossary() for term in row[0].split(",") if len(term.strip(" *")) > 1]
    assert len(terms) > 40 and [term for term in terms if term not in text] == []


def test_other_names_of_glossary_are_not_used() -> None:
    text = product_text()
    names = [name.strip() for row in glossary() for name in row[2:3] and row[2].split(",") if name.strip()]
    # The words of a name can be on two lines of a comment or message, or be joined in a name of the code.
    joined = re.sub(r'"\s+f?"', " ", text)
    words = f" {re.sub('[^a-z0-9]+', ' ', joined)} "
    used = [name for name in names if f" {name} " in words or f" {name}s " in words]
    assert len(names) > 15 and used == []


def test_readme_has_at_most_150_lines() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
