import os
import signal
import sys
import threading

import pytest

from torchdyn_plan.progress import Lines, progress_bar
from torchdyn_plan.stopping import Terminated, stop_when_safe, terminable


@pytest.fixture(autouse=True)
def interruptible():
    """Ctrl-C as on a terminal: whoever runs the tests in the background has it ignored."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_a_signal_waits_until_it_is_safe(number, error):
    done = []

    def work():
        with terminable(), stop_when_safe() as stopping:
            for step in range(5):
                if step == 2:
                    os.kill(os.getpid(), number)
                done.append(stopping())

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(error):
        work()
    assert done == [False, False, True, True, True]
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_second_signal_does_not_wait():
    done = []

    def work():
        with stop_when_safe():
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGINT)
                done.append("step")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["step"]


def test_other_threads_are_left_alone():
    seen = []

    def work():
        with terminable(), stop_when_safe() as stopping:
            seen.append(stopping())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_in_a_file_there_is_a_line_a_tenth_and_no_carriage_return(capsys):
    with progress_bar(total=250, desc="fit", unit="step") as bar:
        bar.set_postfix({"loss": "0.1"})
        for _ in range(250):
            bar.update()
    lines = capsys.readouterr().err.splitlines(keepends=True)
    assert [line.split(" (")[0] for line in lines] == [f"fit: {tenth} %" for tenth in range(10, 101, 10)]
    assert lines[0].startswith("fit: 10 % (25 of 250 steps, 0:00, loss 0.1)")
    assert not any("\r" in line for line in lines)
    assert list(progress_bar(range(3), desc="x", disable=True)) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def test_one_within_another_says_nothing(capsys):
    for _ in progress_bar(range(2), desc="outer"):
        assert list(progress_bar(range(20), desc="inner")) == list(range(20))
    assert "inner" not in capsys.readouterr().err
    assert Lines.active == 0


def test_that_nobody_reads_is_no_reason_to_stop(monkeypatch):
    class Closed:
        def isatty(self):
            return False

        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Closed())
    assert list(progress_bar(range(20))) == list(range(20))
