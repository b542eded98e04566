import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchdyn_plan.cli.forms import LAYERS as NAMES
from torchdyn_plan.envs import Sensor
from torchdyn_plan.errors import InputError, OutputError
from torchdyn_plan.tasks import load_task
from torchdyn_plan.view import Film, Scenario, files, record_episode, write_film
from torchdyn_plan.view.marks import BLUE, LAYERS, ORANGE, marks_at, ribbon, slack_colours

ROOT = Path(__file__).parents[2]
CHASE = load_task("chase")


@pytest.fixture(scope="module")
def recording():
    return record_episode(Scenario(task=CHASE, planner="corner", episode=2, sensor=Sensor(rate=20.0, noise=0.01)))


@pytest.fixture(scope="module")
def exact():
    return record_episode(Scenario(task=CHASE, planner="meet", episode=2))


class Slides:
    """A film that draws by itself: a bright bar in a ramp of greys, as far to the right as its step."""

    length = 60
    steps = Film.steps
    recordings = (type("Recorded", (), {"scenario": type("Played", (), {"task": CHASE})})(),)

    def pictures(self, steps):
        for step in steps:
            picture = np.tile(np.arange(64, dtype=np.uint8), (33, 1))
            picture[:, step : step + 4] = 250
            yield np.stack([picture] * 3, axis=-1)


def step_of(picture):
    return int(np.asarray(picture.convert("L"))[16].argmax())


def test_the_command_line_knows_the_layers():
    assert NAMES == LAYERS


def test_layers_have_as_many_marks_at_every_step(recording):
    counts = [
        {name: len(marks.places) for name, marks in marks_at(recording, step).items()}
        for step in range(recording.length + 1)
    ]
    assert all(count == counts[0] for count in counts)
    assert set(counts[0]) == set(LAYERS)
    for step in (0, recording.length // 2, recording.length):
        for marks in marks_at(recording, step).values():
            assert all(np.isfinite(value).all() for value in marks)
            assert ((marks.colours >= 0.0) & (marks.colours <= 1.0)).all()


def test_nothing_of_a_plan_is_seen_before_the_first(exact):
    assert exact.insight(0) is None
    for name in ("region", "forecast", "candidates"):
        assert (marks_at(exact, 0)[name].colours[:, 3] == 0.0).all()
        assert (marks_at(exact, 20)[name].colours[:, 3] > 0.0).any()


def test_candidates_are_blue_where_the_robot_is_early_and_orange_where_it_is_late():
    colours = slack_colours(np.array([9.0, 0.0, -9.0, -np.inf]))
    np.testing.assert_allclose(colours, [BLUE, (1.0, 1.0, 1.0), ORANGE, ORANGE])


def test_a_forecast_is_fainter_and_wider_where_it_is_less_sure(exact):
    insight = exact.insights[9]
    sure = insight._replace(half_width=torch.full_like(insight.half_width, 0.01))
    unsure = insight._replace(half_width=torch.full_like(insight.half_width, 0.5))
    one, other = (ribbon(which, insight.begin, 0.06) for which in (sure, unsure))
    assert (one.colours[:, 3] > other.colours[:, 3]).all()
    assert (one.sizes[:, :2] < other.sizes[:, :2]).all()


def test_a_forecast_loses_what_has_passed(exact):
    insight = exact.insights[0]
    seen = [(ribbon(insight, step, 0.06).colours[:, 3] > 0.0).sum() for step in (0, 100, 301)]
    assert seen[0] > seen[1] > seen[2] == 0


@pytest.mark.parametrize("ending", [".webp", ".gif"])
def test_films_last_as_long_as_they_should(ending, tmp_path):
    out = tmp_path / f"film{ending}"
    write_film(Slides(), out, fps=10.0, speed=0.5, hold=0.5)
    steps, milliseconds = [], 0
    with Image.open(out) as film:
        for number in range(film.n_frames):
            film.seek(number)
            film.load()
            milliseconds += film.info["duration"]
            steps.append(step_of(film))
    # 60 steps of 20 ms at half speed are 2.4 s, and the last picture stays for 0.5 s.
    assert milliseconds == pytest.approx(2900, abs=150)
    np.testing.assert_allclose(steps[:25], np.linspace(0, 60, 25), atol=2)
    assert steps[-1] == pytest.approx(60, abs=1)


def test_a_strip_is_read_as_a_page(tmp_path):
    write_film(Slides(), tmp_path / "strip.png", strip=7)
    sheet = Image.open(tmp_path / "strip.png")
    assert sheet.size == (4 * 64 + 3 * files.GAP, 2 * 33 + files.GAP)
    places = [(column * (64 + files.GAP), row * (33 + files.GAP)) for row in range(2) for column in range(4)]
    shown = [step_of(sheet.crop((left, top, left + 64, top + 33))) for left, top in places]
    assert shown[:7] == [0, 10, 20, 30, 40, 50, 60]
    assert np.asarray(sheet)[-1, -1, 0] == 255


def test_an_mp4_has_its_pictures_or_says_what_it_needs(tmp_path):
    out = tmp_path / "film.mp4"
    try:
        import imageio_ffmpeg
    except ImportError:
        with pytest.raises(InputError, match="imageio-ffmpeg"):
            write_film(Slides(), out)
        assert not out.exists()
        return
    write_film(Slides(), out, fps=10.0, speed=0.5, hold=0.5)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(out))
    assert frames == pytest.approx(29, abs=1)
    assert seconds == pytest.approx(2.9, abs=0.2)


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("film.avi", {}, r"\.avi"),
        ("film", {}, "film"),
        ("film.png", {"strip": 0}, "strip"),
        ("film.webp", {"quality": 101}, "quality"),
        ("film.webp", {"fps": 0.0}, "fps"),
        ("film.webp", {"speed": -1.0}, "speed"),
        ("film.webp", {"hold": float("nan")}, "hold"),
    ],
)
def test_a_film_that_cannot_be_leaves_no_file(name, changes, words, tmp_path):
    with pytest.raises(InputError, match=words):
        write_film(Slides(), tmp_path / name, **changes)
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_film(Slides(), tmp_path / "file" / "film.webp")


def test_films_of_nothing_or_of_no_size_are_refused(recording):
    with pytest.raises(InputError, match="at least one"):
        Film([])
    with pytest.raises(InputError, match="width"):
        Film([recording], width=10)


@pytest.mark.slow
def test_a_command_draws_an_episode_of_two_planners(tmp_path):
    """In a process of its own: graphics are chosen when MuJoCo is imported."""
    words = ["record", "--task", "chase", "--planners", "pursuit", "meet", "--episode", "2", "--film.speed", "2"]
    words += ["--film.fps", "5", "--film.width", "96", "--film.height", "80", "--out", "new/film.webp"]
    command = [sys.executable, "-m", "torchdyn_plan", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    if "cannot draw" in ran.stderr:
        assert not (tmp_path / "new").exists()
        pytest.skip("no graphics here")
    assert ran.returncode == 0, ran.stderr
    assert "meet: met after" in ran.stdout
    with Image.open(tmp_path / "new" / "film.webp") as film:
        assert film.width == 2 * 96 + 4
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(film.n_frames - 1)
        last = np.asarray(film.convert("RGB")).astype(int)
    assert (np.abs(first - last).max(-1) > 40).mean() > 0.01
