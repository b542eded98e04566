"""README and the pages of docs: their Python runs, their commands are understood, their links lead somewhere."""

import functools
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scripts import run
from torchdyn_plan.cli import commands, main

ROOT = Path(__file__).parent.parent
WALKS = {"own-task.md"}
"""Pages whose blocks build on one another: `test_a_walk_is_walked` runs them in order."""
DOCS = sorted((ROOT / "docs").rglob("*.md"))
WHOLE = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *DOCS]
"""Every page whose links are followed."""
PAGES = [ROOT / "README.md", *(file for file in DOCS if file.name not in WALKS)]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LINK = re.compile(r"\]\(([^)\s]+)\)")


def blocks(language):
    """Page, number and text of each code block of a language, and of what is printed right below it."""
    for page in PAGES:
        found = re.finditer(rf"```{language}\n(.*?)```(?:\n\n```text\n(.*?)```)?", page.read_text(), re.DOTALL)
        for number, match in enumerate(found):
            yield pytest.param(match[1], match[2], id=f"{page.name}-{number}")


def same(expected, printed):
    """Whether two outputs agree but for numbers, which may differ by a few units on another machine."""
    numbers = r"\d+(?:\.\d+)?"
    assert re.sub(numbers, "#", printed).split() == re.sub(numbers, "#", expected).split()
    for one, other in zip(re.findall(numbers, expected), re.findall(numbers, printed), strict=True):
        assert abs(float(one) - float(other)) <= max(5.0, 0.1 * abs(float(one))), (one, other)


@pytest.mark.parametrize(("code", "printed"), list(blocks("python")))
def test_code_runs_and_prints_what_the_page_says(code, printed, tmp_path):
    ran = run(code, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    comment = re.search(r"^print\(.*#  *(.*)$", code, re.MULTILINE)
    expected = printed or (comment and comment[1])
    if expected:
        same(expected, ran.stdout)


def command_lines():
    """Every command line on the pages, in blocks and in running text."""
    for page in PAGES:
        text = page.read_text()
        lines = [line for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
        lines += [
            code.replace("\n", " ") for code in re.findall(r"`(torchdyn-plan [^`]*|python benchmarks/[^`]*)`", text)
        ]
        for line in lines:
            for command in line.split("#")[0].split("&&"):
                words = shlex.split(command)
                if words[:1] == ["torchdyn-plan"] or words[:1] == ["python"]:
                    yield pytest.param(words, id=" ".join(words))


@pytest.mark.parametrize("words", list(command_lines()))
def test_commands_are_understood(words, monkeypatch):
    if words[0] == "python":
        assert (ROOT / words[1]).is_file()
        return
    understood = []
    for what in ("run", "train"):
        monkeypatch.setattr(commands, what, lambda *given: understood.append(given))
    main(words[1:])
    assert len(understood) == 1


def steps_of(page):
    """Code blocks of a page in their order: language, text, and what its last comment says that it prints."""
    for language, text in re.findall(r"```(python|bash)\n(.*?)```", page.read_text(), re.DOTALL):
        comment = re.search(r"^ *print\(.*#  *(.*)$", text, re.MULTILINE)
        yield language, text, comment and comment[1]


@pytest.mark.parametrize("name", sorted(WALKS))
def test_a_walk_is_walked(name, tmp_path):
    printed = ""
    for language, text, says in steps_of(ROOT / "docs" / name):
        file = re.match(r"# (\S+\.py)\n", text)
        if file:
            (tmp_path / file[1]).write_text(text)
            continue
        commands = [shlex.split(line)[1:] for line in text.splitlines()] if language == "bash" else []
        told = f"from torchdyn_plan.cli import main\nfor words in {commands}:\n    main(words)"
        code = text if language == "python" else told
        ran = run(f"import sys\nsys.path.insert(0, '.')\n{code}", cwd=tmp_path)
        assert ran.returncode == 0, (text, ran.stderr)
        if says:
            same(says, ran.stdout)
        printed += ran.stdout
    table = re.findall(r"^(pursuit|straight|learned) +(\d+) %", printed, re.MULTILINE)
    met = {planner: int(share) for planner, share in table}
    assert met["learned"] >= met["straight"] >= met["pursuit"], printed
    assert met["learned"] >= 90, printed


@functools.cache
def anchors(page):
    """What a page's headings can be linked by."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    return {slug(heading) for heading in re.findall(r"^#+ +(.*)$", text, re.MULTILINE)}


def slug(heading):
    words = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
    return re.sub(r"[-\s]+", "-", words)


@pytest.mark.parametrize("page", WHOLE, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for link in LINK.findall(page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        # The site has the changelog as a page.
        assert target.exists() or link == "changelog.md", link
        if anchor:
            assert anchor in anchors(target), link


def test_slugs_are_those_of_the_site():
    markdown = pytest.importorskip("markdown.extensions.toc")
    for heading in ("A planner, with nothing trained", "The scene `paper`", "A & B"):
        plain = heading.replace("`", "")
        assert slug(heading) == markdown.slugify(plain, "-"), heading


def test_every_page_is_in_the_navigation():
    named = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert named == {str(page.relative_to(ROOT / "docs")) for page in DOCS} | {"changelog.md"}


def test_the_api_names_modules_that_there_are():
    named = [
        name
        for page in (ROOT / "docs" / "api").glob("*.md")
        for name in re.findall(r"^::: (\S+)$", page.read_text(), re.M)
    ]
    assert len(named) > 20
    for name in named:
        assert importlib.util.find_spec(name) is not None, name


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None:
        pytest.skip("mkdocs builds the site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(build, cwd=ROOT, env=quiet, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "WARNING" not in built.stderr
    assert "DynamicPlanner" in (tmp_path / "api" / "planners" / "index.html").read_text()
    assert (tmp_path / "source" / "examples" / "own_task.py").is_file()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_run_and_are_stripped(notebook, tmp_path):
    cells = json.loads(notebook.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert not any(cell.get("outputs") for cell in cells)
    ran = run("\n".join(code), cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout


def test_there_are_two_notebooks():
    assert [file.stem for file in NOTEBOOKS] == ["first_plan", "kinematics"]


def test_readme_fits_on_a_few_screens():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_version_is_the_same_everywhere():
    version = importlib.import_module("torchdyn_plan").__version__
    assert f'\nversion = "{version}"\n' in (ROOT / "pyproject.toml").read_text()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    (first, date) = re.findall(r"^## (\S+) \((\S+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert first == version
    assert f'\ndate-released: "{date}"\n' in (ROOT / "CITATION.cff").read_text()
