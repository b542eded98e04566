"""A task in one file outside the package: every command takes it, and speaks in its words."""

import ast
import re
from pathlib import Path

import pytest

from torchdyn_plan import cli
from torchdyn_plan.tasks import load_task

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "examples" / "own_task.py").read_text()
COMMANDS = re.findall(r"^    torchdyn-plan (.+)$", ast.get_docstring(ast.parse(TEXT), clean=False), re.MULTILINE)


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What each command of the example's docstring prints, run one after the other."""
    folder = tmp_path_factory.mktemp("catch")
    said = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("torchdyn_plan.training.path_data.SCORED", 256)
        for command in COMMANDS:
            words = command.replace("runs/catch", str(folder)).split()
            patch.setattr("sys.stdout", output := Output())
            cli.main(words)
            said[" ".join(words[:2])] = output.text
    return folder, said


class Output:
    """Keeps what is printed."""

    text = ""

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def test_the_example_shows_how_to_collect_train_and_evaluate():
    shown = [command.split()[0] for command in COMMANDS]
    assert shown == ["collect", "collect", "train", "train", "evaluate"]
    assert all("--task examples.own_task:TASK" in command for command in COMMANDS)


def test_data_and_weights_lie_where_they_were_asked_for(answers):
    folder, _ = answers
    for name in ("paths-0-000", "arrivals-0-000", "forecaster/forecaster", "eta/eta"):
        assert (folder / f"{name}.safetensors").is_file()


def test_the_table_speaks_in_the_tasks_words(answers):
    (table,) = (said for words, said in answers[1].items() if words.startswith("evaluate"))
    assert "catch" in table
    assert "speed 1 m/s" in table
    assert "steps to catch" in table
    for foreign in ("trap", "ball", "reach", "friction", "pocket"):
        assert foreign not in table


def test_to_plan_ahead_beats_to_run_after(answers):
    (table,) = (said for words, said in answers[1].items() if words.startswith("evaluate"))
    success = {name: int(share) for name, share in re.findall(r"^(pursuit|intercept) +(\d+) %", table, re.MULTILINE)}
    assert success["intercept"] > success["pursuit"] + 20


def test_a_mistake_in_its_settings_is_named_in_its_words(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "--task", "examples.own_task:TASK", "--speed", "5"])
    assert "speed must be in [0, 4], got 5.0" in capsys.readouterr().err


def test_it_is_short_and_a_task_like_those_that_ship(monkeypatch):
    assert len(TEXT.splitlines()) <= 120
    monkeypatch.chdir(ROOT)
    task = load_task("examples.own_task:TASK")
    assert task.name == "catch"
    assert task.default_planners == ("pursuit", "intercept")
