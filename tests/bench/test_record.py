import json

import pytest

from torchdyn_plan.bench.record import Record
from torchdyn_plan.errors import OutputError


def test_a_row_is_in_the_file_before_anybody_is_told(tmp_path):
    out = tmp_path / "new" / "figures.json"

    def closed(row):
        raise BrokenPipeError

    record = Record(out, show=closed, size=3)
    with pytest.raises(BrokenPipeError):
        record.add({"value": float("nan"), "other": float("inf"), "whole": 2.0})
    content = json.loads(out.read_text())
    assert content["rows"] == [{"value": None, "other": None, "whole": 2.0}]
    assert content["config"] == {"size": 3}
    assert content["complete"] is False


def test_a_run_begins_anew_and_keeps_the_old_file_until_its_first_row(tmp_path):
    out = tmp_path / "figures.json"
    out.write_text("old")
    record = Record(out)
    assert out.read_text() == "old"
    record.add({"value": 1})
    assert record.end() == [{"value": 1}]
    assert json.loads(out.read_text())["complete"]
    assert [file.name for file in tmp_path.iterdir()] == ["figures.json"]


def test_a_file_that_cannot_be_written_is_told_at_once(tmp_path):
    with pytest.raises(OutputError, match="is a folder"):
        Record(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="not writable"):
        Record(tmp_path / "file" / "figures.json")


def test_without_a_file_rows_are_only_kept():
    told = []
    record = Record(show=told.append)
    record.add({"value": 1})
    assert record.end() == told == [{"value": 1}]
