import contextlib
import http.client
import socket
import sys
import threading
import time

import pytest

from torchdyn_plan import cli
from torchdyn_plan.errors import InputError
from torchdyn_plan.tasks import load_task
from torchdyn_plan.view import Page, Scenario, page

pytest.importorskip("viser")
pytest.importorskip("mjviser")
CHASE = load_task("chase")


def until(holds, seconds=60.0):
    begun = time.monotonic()
    while not holds():
        assert time.monotonic() - begun < seconds, "it has not come to pass"
        time.sleep(0.01)


def free_port():
    with contextlib.closing(socket.socket()) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def shows(served, *planners):
    return tuple(recording.scenario.planner for recording in served.recordings) == planners


@pytest.fixture(scope="module")
def served():
    one = Page([Scenario(task=CHASE, planner="pursuit", episode=2)], port=free_port())
    yield one
    one.close()


def test_the_page_is_there_for_this_machine_alone(served):
    port = served.server.get_port()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    # Every other address of the machine, of which 127.0.0.2 is one, is refused; a page for all would take it.
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port), timeout=10)
    assert served.server.get_host() == page.HOST == "127.0.0.1"


def test_no_tunnel_leads_outside(served):
    assert served.server.request_share_url() is None
    assert served.server._share_tunnel is None


def test_it_plays_stops_at_the_end_steps_and_scrubs(served):
    until(lambda: shows(served, "pursuit"))
    served.controls.speed = 20.0
    until(lambda: served.step >= served.length > 0 and not served.playing)
    served.controls._jump("<")
    assert served.step == served.length - 1
    served.controls._jump("|<")
    assert served.step == 0
    served.go_to(1e9)
    assert served.step == served.length
    assert "pursuit" in served.controls._said.content
    served.controls.play()
    assert served.playing
    until(lambda: served.step > 0)
    served.controls.pause()


def test_another_planner_and_one_beside_it(served):
    until(lambda: shows(served, "pursuit"))
    served.controls._left.value = "corner"
    until(lambda: shows(served, "corner"))
    served.controls._right.value = "pursuit"
    until(lambda: shows(served, "corner", "pursuit"))
    served.controls._settings["speed"].value = 0.4
    until(lambda: served.recordings[0].scenario.chosen.speed == 0.4)
    served.go_to(served.length)
    assert served.controls._said.content.count("met after") == 2
    served.controls._right.value = "none"
    until(lambda: shows(served, "corner"))


def test_a_sensor_and_its_track_are_chosen_on_the_page(served):
    served.controls._sensor["rate"].value = 20.0
    served.controls._track.value = "kalman"
    until(lambda: served.recordings and served.recordings[0].scenario.track is not None)
    sensor = served.recordings[0].scenario.sensor
    assert sensor.rate == 20.0
    served.controls._track.value = "none"
    served.controls._sensor["rate"].value = 0.0
    until(lambda: served.recordings[0].scenario.sensor is None)


def test_what_goes_wrong_is_said_on_the_page(served, monkeypatch, capsys):
    def fail(scenario, progress):
        raise ValueError("the arm is made of cheese")

    before = served.recordings
    monkeypatch.setattr(page, "record_episode", fail)
    served.controls._episode.value = 4
    until(lambda: "made of cheese" in served.controls._state.content)
    assert "**Error.**" in served.controls._state.content
    assert not served.playing
    assert served.recordings is before
    assert "made of cheese" in capsys.readouterr().err
    monkeypatch.undo()
    served.controls._episode.value = 5
    until(lambda: served.recordings[0].scenario.episode == 5)
    assert "Error" not in served.controls._state.content


def test_what_is_not_wanted_any_more_is_given_up(served, monkeypatch):
    begun, kept = threading.Event(), page.record_episode

    def endless(scenario, progress):
        if scenario.episode != 7:
            return kept(scenario, progress)
        begun.set()
        while True:
            progress(1)
            time.sleep(0.01)

    monkeypatch.setattr(page, "record_episode", endless)
    served.controls._episode.value = 7
    assert begun.wait(60.0)
    served.controls._episode.value = 8
    until(lambda: served.recordings[0].scenario.episode == 8)


@pytest.mark.parametrize("count", [0, 3])
def test_one_or_two_planners_are_shown(count):
    with pytest.raises(InputError, match="one planner or two"):
        Page([Scenario(task=CHASE, planner="meet")] * count)


@pytest.mark.parametrize("port", [0, 70000, 80.5])
def test_a_port_is_a_port(port):
    with pytest.raises(InputError, match="port"):
        Page([Scenario(task=CHASE, planner="meet")], port=port)


@pytest.mark.parametrize("missing", ["viser", "mjviser"])
def test_without_its_extra_the_page_says_so(missing, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit):
        cli.main(["view", "--task", "chase"])
    assert capsys.readouterr().err == (
        "torchdyn-plan: error: the page needs its extra: pip install 'torchdyn-plan[view]'\n"
    )


def test_no_other_host_is_offered(capsys):
    with pytest.raises(SystemExit):
        cli.main(["view", "--host", "0.0.0.0"])
    assert "--host" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["view", "--help"])
    assert "--host" not in capsys.readouterr().out
