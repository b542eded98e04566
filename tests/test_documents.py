"""README and the pages of docs: their Python runs, their commands are understood, their links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from tests.scripts import run
from torchdyn_plan.cli import commands, main

ROOT = Path(__file__).parent.parent
WALKS = {"own-task.md"}
"""Pages whose blocks build on one another: `test_a_walk_is_walked` runs them in order."""
PAGES = [ROOT / "README.md", *sorted(file for file in (ROOT / "docs").glob("*.md") if file.name not in WALKS)]


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


@pytest.mark.parametrize("page", [ROOT / "README.md", *(ROOT / "docs").glob("*.md")], ids=lambda page: page.name)
def test_links_lead_to_files(page):
    for link in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not link.startswith("http"):
            assert (page.parent / link).exists(), link


def test_readme_fits_on_a_few_screens():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
