import errno
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from torchdyn_plan.errors import InputError, OutputError, WeightsError
from torchdyn_plan.files import (
    _tidied,
    check_writable_folder,
    exists,
    is_file,
    read_json,
    tensor_bytes,
    write_json,
    write_tensors,
    write_whole,
)
from torchdyn_plan.nets import Actor
from torchdyn_plan.planners import DynamicPlanner, PolicyPlanner
from torchdyn_plan.tasks.trapper.solvable import ArrivalMap, save_arrivals
from torchdyn_plan.training.checkpoint import write_checkpoint


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


@pytest.fixture
def full(monkeypatch):
    """A disk with room for so many bytes; the limit holds for a file, and for whatever library writes it."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda room: resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def kinds():
    """Everything that writes a file, by name: what is written, and a file that it leaves."""
    torch.manual_seed(0)
    network = Actor(hidden=64, layers=2)
    planner = DynamicPlanner(PolicyPlanner(network), network_free, lambda state, goal: goal[..., 0])
    tensors = {"steps": torch.zeros(4096)}
    return {
        "json": (lambda folder: write_json(folder / "a.json", ["text"] * 5000), "a.json"),
        "tensors": (lambda folder: write_tensors(folder / "a.safetensors", tensors), "a.safetensors"),
        "weights": (network.save_pretrained, "policy.safetensors"),
        "planner": (planner.save_pretrained, "planner.json"),
        "checkpoint": (
            lambda folder: write_checkpoint(folder / "c.safetensors", tensors, settings={}, progress={}),
            "c.safetensors",
        ),
        "map": (
            lambda folder: save_arrivals(ArrivalMap(torch.zeros(90, 90), 1.0), folder / "m.safetensors"),
            "m.safetensors",
        ),
        "plot": (lambda folder: write_whole(folder / "a.png", save_figure), "a.png"),
    }


def network_free(history):
    return history


def save_figure(file):
    from matplotlib.figure import Figure

    Figure().savefig(file, format="png")


@pytest.mark.parametrize("kind", ["json", "tensors", "weights", "planner", "checkpoint", "map", "plot"])
def test_a_full_disk_is_one_clear_error_and_what_was_there_stays(tmp_path, full, kind):
    write, name = kinds()[kind]
    write(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    full(600)
    with pytest.raises(OutputError, match=r"cannot write .*: (File too large|.*os error 27)"):
        write(tmp_path)
    with pytest.raises(OutputError):
        write(tmp_path / "new")
    full(resource.RLIM_INFINITY)
    assert name in before
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_files_get_the_mode_that_the_umask_leaves(tmp_path, umask):
    former = os.umask(umask)
    try:
        for write, _ in kinds().values():
            write(tmp_path)
    finally:
        os.umask(former)
    modes = {file.name: file.stat().st_mode & 0o777 for file in tmp_path.iterdir()}
    assert len(modes) >= 8
    assert set(modes.values()) == {0o666 & ~umask}, modes


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EIO, errno.EROFS])
def test_a_folder_that_fails_is_told_at_any_step(tmp_path, monkeypatch, code):
    def fail(*_, **__):
        raise OSError(code, os.strerror(code))

    for owner, name in (
        (tempfile, "mkdtemp"),
        (os, "fsync"),
        (Path, "replace"),
        (Path, "chmod"),
        (Path, "mkdir"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fail)
            with pytest.raises(OutputError, match=f"cannot write '.*a.json': {os.strerror(code)}"):
                write_json(tmp_path / "new" / "a.json", 1)
        assert list(tmp_path.iterdir()) == []


def test_names_and_places_that_cannot_be(tmp_path):
    for path in (tmp_path / ("x" * 300), tmp_path / ("y" * 300) / "a.json", tmp_path / "a\0b"):
        assert not exists(path)
        assert not is_file(path)
        with pytest.raises(OutputError, match="cannot write"):
            write_json(path, 1)
        with pytest.raises(WeightsError, match="no weights"):
            Actor.from_pretrained(path)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_left_is_removed_by_the_next_and_nothing_else(tmp_path):
    script = (
        "import os, signal, sys; from pathlib import Path; from torchdyn_plan.files import write_whole\n"
        "def write(file):\n    file.write_text('half'); print('writing', flush=True); sys.stdin.read()\n"
        "write_whole(Path(sys.argv[1]) / 'a.txt', write)"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    killed, living = (subprocess.Popen([sys.executable, "-c", script, tmp_path], **pipes) for _ in range(2))
    for process in (killed, living):
        assert process.stdout.readline() == "writing\n"
    killed.kill()
    killed.communicate()
    (tmp_path / ".other.tmp").mkdir()
    assert len(list(tmp_path.iterdir())) == 3
    _tidied.discard(tmp_path)
    write_json(tmp_path / "b.json", 1)
    left = {path.name for path in tmp_path.iterdir()} - {"b.json", ".other.tmp"}
    assert len(left) == 1, "that of the living writer"
    living.communicate("")
    assert living.returncode == 0
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", "b.json", ".other.tmp"}


def test_probes_of_many_processes_do_not_meet(tmp_path):
    """Each has a name of its own: none finds that of another, or removes it."""
    with ThreadPoolExecutor(8) as pool:
        assert len(list(pool.map(lambda _: check_writable_folder(tmp_path), range(200)))) == 200
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b"NaN", b"[Infinity]", b"[" * 10**5, b"1" * 5000])
def test_what_is_no_json_is_named(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match=r"a\.json' is no JSON file"):
        read_json(path)


def test_a_number_of_a_larger_tensor_has_bytes():
    table = torch.arange(18.0).reshape(2, 9)
    for tensor in (table[:1, 3], table[0, 3], table[:, 3], table.mT, torch.tensor([], dtype=torch.int64)):
        assert bytes(tensor_bytes(tensor)) == tensor.numpy().tobytes()
