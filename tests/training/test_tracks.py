"""A person's own tracks: read from each kind of file, brought to control steps, and a forecaster trained on them."""

import csv
import sys

import numpy as np
import pytest
import torch

from tests.training.toy_task import TASK as TOY
from torchdyn_plan.cli import main
from torchdyn_plan.errors import InputError
from torchdyn_plan.training.collect import collect_tracks
from torchdyn_plan.training.tracks import at_control_steps, read_tracks, shard_of
from torchdyn_plan.training.windows import load_paths

HEADER = ("time", "x", "y", "z", "track")


def samples(count=4, length=40, step=0.03, dims=3):
    """Rows of a recording: tracks that go straight, a second apart, frame by frame as a tracker writes them."""
    draw = np.random.default_rng(0)
    start, velocity = draw.uniform(-1, 1, (2, count, dims))
    rows = []
    for frame in range(length):
        for track in range(count):
            moment = step * frame + 1.0 * track
            rows.append([moment, *(start[track] + velocity[track] * step * frame), f"walker {track}"])
    return rows, start, velocity


def write_csv(file, rows, header=HEADER):
    with file.open("w", newline="") as opened:
        csv.writer(opened).writerows([header, *rows])
    return file


def test_a_csv_is_read_and_straight_tracks_stay_straight(tmp_path):
    rows, start, velocity = samples()
    tracks = read_tracks(write_csv(tmp_path / "tracks.csv", rows))
    paths = at_control_steps(tracks, 0.01)
    assert len(paths) == 4
    for path, first, speed in zip(paths, start, velocity, strict=True):
        assert len(path) == 118
        expected = first + speed * 0.01 * np.arange(118)[:, None]
        torch.testing.assert_close(path, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)
    shard = shard_of(paths, 0.01)
    torch.testing.assert_close(shard["velocity"], torch.from_numpy(np.linalg.norm(velocity, axis=1)).float())
    assert shard["start"].tolist() == [0, 118, 236, 354]


def test_every_kind_of_file_tells_the_same(tmp_path):
    rows, *_ = samples()
    expected = at_control_steps(read_tracks(write_csv(tmp_path / "a.csv", rows)), 0.02)
    numbered = np.array([[*row[:4], float(row[4].split()[1])] for row in rows])
    np.save(tmp_path / "plain.npy", numbered)
    named = np.rec.fromarrays(numbered.T, names=",".join(HEADER))
    np.save(tmp_path / "named.npy", named)
    np.savez(tmp_path / "several.npz", **{name: numbered[:, place] for place, name in enumerate(HEADER)})
    write_csv(tmp_path / "other_words.csv", [["?", *row] for row in rows], ("colour", "T", "X", "Y", "Z", "track_id"))
    for name in ("plain.npy", "named.npy", "several.npz", "other_words.csv"):
        found = at_control_steps(read_tracks(tmp_path / name), 0.02)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other)


def test_parquet_is_read_where_pyarrow_is_and_asked_for_where_it_is_not(tmp_path, monkeypatch):
    (tmp_path / "tracks.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="needs pyarrow, which is not installed"):
        read_tracks(tmp_path / "tracks.parquet")
    monkeypatch.undo()
    pyarrow = pytest.importorskip("pyarrow")
    with pytest.raises(InputError, match="is not a Parquet file"):
        read_tracks(tmp_path / "tracks.parquet")
    rows, *_ = samples()
    table = pyarrow.table({name: [row[place] for row in rows] for place, name in enumerate(HEADER)})
    pyarrow.parquet.write_table(table, tmp_path / "tracks.parquet")
    expected = at_control_steps(read_tracks(write_csv(tmp_path / "a.csv", rows)), 0.02)
    for one, other in zip(at_control_steps(read_tracks(tmp_path / "tracks.parquet"), 0.02), expected, strict=True):
        torch.testing.assert_close(one, other)


def test_without_heights_they_are_zero_and_without_names_all_is_one_track(tmp_path):
    rows, *_ = samples(count=1, dims=2)
    tracks = read_tracks(write_csv(tmp_path / "a.csv", [row[:3] for row in rows], ("time", "x", "y")))
    (path,) = at_control_steps(tracks, 0.03)
    assert path.shape == (40, 3)
    assert not path[:, 2].any()


def test_a_gap_cuts_a_track_in_two(tmp_path):
    rows, *_ = samples(count=1)
    for row in rows[25:]:
        row[0] += 2.0
    paths = at_control_steps(read_tracks(write_csv(tmp_path / "a.csv", rows)), 0.03)
    assert [len(path) for path in paths] == [25, 15]


def spoiled(row=None, column=None, value=None, header=HEADER, cut=None):
    def write(folder):
        rows, *_ = samples()
        if row is not None:
            rows[row - 2][HEADER.index(column)] = value
        if cut is not None:
            rows[cut - 2] = rows[cut - 2][:3]
        return write_csv(folder / "a.csv", rows, header)

    return write


def array(name, values, save=np.save):
    def write(folder):
        save(folder / name, values)
        return folder / name

    return write


def text(name, content):
    def write(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return write


BAD = {
    "no number": (spoiled(17, "x", "left"), r"a.csv', row 17, column x: must be a number of at most .* got 'left'"),
    "nothing": (spoiled(5, "y", ""), r"row 5, column y: must be a number .* got ''"),
    "not a number": (spoiled(5, "z", "nan"), r"row 5, column z: must be a number"),
    "too far": (spoiled(9, "x", 1e9), r"row 9, column x: must be a number of at most 1e\+06 m, got '1000000000.0'"),
    "time": (spoiled(6, "time", "inf"), r"row 6, column time: must be a number, got 'inf'"),
    "earlier": (spoiled(10, "time", -1.0), r"row 10, column time: must be later than 0.03 s, .* got -1 s"),
    "the same": (spoiled(6, "time", 0.0), r"row 6, column time: must be later than 0 s"),
    "short row": (spoiled(cut=8), r"row 8: must have 5 columns, got 3"),
    "no time": (spoiled(header=("when", *HEADER[1:])), r"lacks a column time or t or timestamp; it has: when, x, y"),
    "two of a kind": (spoiled(header=("t", "x", "y", "time", "track")), "has several columns for time: time, t"),
    "empty": (text("a.csv", b""), "lacks a column time"),
    "header alone": (text("a.csv", b"time,x,y\n"), "holds no samples"),
    "not text": (text("a.csv", b"\xff\xfe\x00time"), "is not a CSV"),
    "other": (text("a.xlsx", b""), "must be one of .csv, .parquet, .npy, .npz"),
    "no array": (text("a.npy", b"what"), "is not a NumPy file"),
    "three columns": (array("a.npy", np.zeros((5, 3))), r"must have shape \(n, 4\), .* got \(5, 3\)"),
    "in an array": (
        array("a.npy", np.array([[0, 0, 0, 0], [1, np.nan, 0, 0.0]])),
        r"row 1, column x: .* got nan",
    ),
    "lengths": (
        array("a.npz", None, lambda file, _: np.savez(file, time=np.zeros(3), x=np.zeros(3), y=np.zeros(2))),
        "columns must be of one length",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_gets_one_error_that_names_the_place(name, tmp_path):
    write, message = BAD[name]
    with pytest.raises(InputError, match=message):
        read_tracks(write(tmp_path))


def test_a_file_that_is_not_there_and_times_in_other_units_are_named(tmp_path):
    with pytest.raises(InputError, match="there is no file of tracks"):
        read_tracks(tmp_path / "nowhere.csv")
    rows, *_ = samples(count=1)
    for row in rows:
        row[0] *= 1e9
    with pytest.raises(InputError, match="column time: must be in seconds"):
        at_control_steps(read_tracks(write_csv(tmp_path / "a.csv", rows)), 0.01)


def long_tracks(folder, count=12):
    rows, *_ = samples(count=count, length=300)
    return write_csv(folder / "tracks.csv", rows)


def test_a_forecaster_is_trained_on_them_by_the_commands(tmp_path, capsys):
    file, data = long_tracks(tmp_path), tmp_path / "data"
    place = "tests.training.toy_task:TASK"
    main(["collect", "paths", "--task", place, "--from", str(file), "--out", str(data)])
    assert f"12 tracks in control steps of {TOY.control_step:g} s" in capsys.readouterr().out
    paths = load_paths(data)
    assert len(paths.length) == 12
    main(["train", "forecaster", "--task", place, "--data", str(data), "--out", str(tmp_path / "net"), "--steps", "2"])
    assert list((tmp_path / "net").rglob("*.safetensors"))


def test_the_same_file_again_changes_nothing_and_another_is_refused(tmp_path):
    file, data = long_tracks(tmp_path), tmp_path / "data"
    assert collect_tracks(TOY, file, data) == collect_tracks(TOY, file, data) == 12
    other = long_tracks(tmp_path, count=13)
    with pytest.raises(InputError, match="holds other paths: give another folder or seed, or delete it"):
        collect_tracks(TOY, other, data)
    assert collect_tracks(TOY, other, data, seed=1) == 13
    assert len(load_paths(data).length) == 25


def test_tracks_that_are_too_short_for_the_forecaster_are_refused(tmp_path):
    rows, *_ = samples(length=3)
    with pytest.raises(InputError, match=r"needs 2 tracks of .* control steps"):
        collect_tracks(TOY, write_csv(tmp_path / "a.csv", rows), tmp_path / "data")


def test_arrivals_come_from_no_file(tmp_path):
    file = long_tracks(tmp_path)
    words = ["collect", "arrivals", "--task", "tests.training.toy_task:TASK", "--from", str(file)]
    with pytest.raises(SystemExit):
        main([*words, "--out", str(tmp_path / "data")])
