"""Where the points of a sweep are run makes no difference to what comes of them."""

import json
import sys
import types
from functools import partial

import pytest

from tests.evaluation.toy_task import TASK
from torchdyn_plan.cli import forms
from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation import engines
from torchdyn_plan.evaluation.sweep import sweep

ASKED = {"over": "drift", "values": (0.0, 0.02), "repeats": 2, "episodes": 3, "num_threads": 1, "progress": False}


class LastFirst(types.ModuleType):
    """As much of Ray as is used, in one process; what was ordered last is done first."""

    def __init__(self):
        super().__init__("ray")
        self.log = []

    def is_initialized(self):
        return False

    def init(self, **settings):
        self.log.append(settings["num_cpus"])

    def shutdown(self):
        self.log.append("shutdown")

    def put(self, value):
        return value

    def remote(self, function):
        return types.SimpleNamespace(remote=lambda *given: partial(function, *given))

    def wait(self, waiting):
        return waiting[-1:], waiting[:-1]

    def get(self, reference):
        return reference()


def files(folder):
    """What a sweep wrote, without the time that it took and the digests that cover it."""
    found = {}
    for path in sorted(folder.rglob("*.json")):
        content = json.loads(path.read_text())
        for outcomes in content.get("planners", {}).values() if path.parent.name == "points" else ():
            del outcomes["seconds"]
        content.pop("content", None)
        for row in content.get("rows", ()):
            row.pop("episodes_per_second")
        found[path.relative_to(folder)] = json.dumps(content)
    return found


def test_workers_give_the_same_bytes_in_whatever_order_they_are_done(tmp_path, monkeypatch):
    here = sweep(TASK, out=tmp_path / "here", **ASKED)
    ray = LastFirst()
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(engines, "find_spec", lambda name: name)
    there = sweep(TASK, out=tmp_path / "there", engine="ray", workers=2, **ASKED)
    assert [(row.settings, row.success) for row in here] == [(row.settings, row.success) for row in there]
    assert files(tmp_path / "here") == files(tmp_path / "there")
    assert ray.log == [2, "shutdown"]
    # What is there already is not run again, and no cluster is started for it.
    sweep(TASK, out=tmp_path / "there", engine="ray", **ASKED)
    assert ray.log == [2, "shutdown"]


def test_a_real_cluster_gives_the_same_bytes(tmp_path, monkeypatch, request):
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", str(request.config.rootpath))
    sweep(TASK, out=tmp_path / "here", **ASKED)
    sweep(TASK, out=tmp_path / "there", engine="ray", workers=2, **ASKED)
    assert files(tmp_path / "here") == files(tmp_path / "there")


def test_what_cannot_be_is_said_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    for error, asked in {
        "workers are those of engine 'ray', got engine 'here'": {"workers": 2},
        "engine 'ray' needs Ray: pip install 'torchdyn-plan\\[ray\\]'": {"engine": "ray"},
        "workers must be >= 1, got 0": {"engine": "ray", "workers": 0},
        "unknown engine 'dask'; choose from here, ray": {"engine": "dask"},
    }.items():
        with pytest.raises(InputError, match=error):
            sweep(TASK, out=tmp_path / "none", **ASKED, **asked)
    assert not (tmp_path / "none").exists()


def test_the_command_line_knows_the_engines():
    assert forms.ENGINES == engines.ENGINES
