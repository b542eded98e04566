import json
import math

import pytest

from torchdyn_plan.errors import OutputError
from torchdyn_plan.files import write_json, write_whole


def test_json_comes_back_and_folders_are_made(tmp_path):
    path = tmp_path / "a" / "b.json"
    content = {"rate": 0.5, "none": None, "list": [1, 2]}
    write_json(path, content)
    assert json.loads(path.read_text()) == content
    assert path.read_text().endswith("\n")


def test_nan_is_refused_and_what_was_there_stays(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, 1)
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, math.nan)
    assert path.read_text() == "1\n"


def test_a_crash_while_writing_leaves_what_was_there_and_no_rubbish(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def crash(temporary):
        temporary.write_text("half")
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        write_whole(path, crash)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write") as caught:
        write_json(tmp_path / "file" / "a.json", 1)
    assert "a.json" in str(caught.value)
