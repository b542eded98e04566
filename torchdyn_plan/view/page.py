"""The page in the browser: an episode step by step, up to two planners side by side, served to this machine only."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from torchdyn_plan.checks import check_number
from torchdyn_plan.errors import InputError, TorchdynPlanError
from torchdyn_plan.view.controls import Controls
from torchdyn_plan.view.recording import Recording, Scenario, record_episode
from torchdyn_plan.view.stage import Stage, camera_of, places_of

HOST = "127.0.0.1"
"""The page is served to this machine only; there is no option for another address."""
RATE = 40.0
"""Most updates of the page per second while it plays [Hz]."""
TOLD_EVERY = 25
"""Control steps between progress messages of a recording."""
FIELD_OF_VIEW = math.radians(45.0)
"""Vertical field of view, as in MuJoCo [rad]."""
WIDER = 2.3
"""Factor on the camera's distance for two worlds."""


class Superseded(Exception):  # noqa: N818
    """The recording in progress has been replaced by another request."""


class Page:
    """Serves the page, records episodes in one thread, and plays them in another."""

    def __init__(self, scenarios: Sequence[Scenario], *, port: int = 8080) -> None:
        """Serve the page, initially with ``scenarios``: one or two, of the same episode.

        Raises:
            InputError: there are none or more than two, the port is invalid, or the page's libraries are missing.
        """
        if not 1 <= len(scenarios) <= 2:
            raise InputError(f"the page shows one planner or two, got {len(scenarios)}")
        check_number("port", port, minimum=1, maximum=65535, integer=True)
        self.server = local_server(port)
        self.recordings: list[Recording] = []
        self.pushed = 0
        """Number of updates sent."""
        self._stages: list[Stage] = []
        self._scene = threading.RLock()
        self._wanted = threading.Condition()
        self._request: tuple[Scenario, ...] | None = tuple(scenarios)
        self._closed = False
        self.step = 0.0
        self.playing = True
        self.controls = Controls(self.server, scenarios, self)
        threads = (self._record_all, self._play)
        self._threads = [threading.Thread(target=target, daemon=True) for target in threads]
        for thread in self._threads:
            thread.start()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self.server.get_port()}"

    @property
    def length(self) -> int:
        """Control steps of the longest recording; 0 before the first one."""
        return max((recording.length for recording in self.recordings), default=0)

    def want(self, scenarios: Sequence[Scenario]) -> None:
        """Show ``scenarios`` as soon as they are recorded; a recording in progress is abandoned."""
        with self._wanted:
            self._request = tuple(scenarios)
            self._wanted.notify_all()

    def go_to(self, step: float) -> None:
        """Show control step ``step``, at most the last one."""
        with self._scene:
            self.step = float(np.clip(step, 0, self.length))
            self._push()

    def close(self) -> None:
        """Stop serving."""
        self._closed = True
        with self._wanted:
            self._wanted.notify_all()
        for thread in self._threads:
            thread.join(timeout=10.0)
        self.server.stop()

    def _record_all(self) -> None:
        """Record requested scenarios as long as the page is served."""
        while not self._closed:
            with self._wanted:
                self._wanted.wait_for(lambda: self._closed or self._request is not None)
                wanted, self._request = self._request, None
            if wanted is not None and not self._closed:
                self._record(wanted)

    def _record(self, wanted: Sequence[Scenario]) -> None:
        """Record and show the ``wanted`` scenarios; errors are shown on the page."""
        try:
            self._show([record_episode(one, lambda step, one=one: self._report(one, step)) for one in wanted])
        except Superseded:
            return
        except Exception as error:  # A planner may raise anything; the page reports it and continues.
            if not isinstance(error, TorchdynPlanError):
                traceback.print_exception(error, file=sys.stderr)
            self.playing = False
            self.controls.say_error(f"{type(error).__name__}: {error}")

    def _report(self, scenario: Scenario, step: int) -> None:
        if self._closed or self._request is not None:
            raise Superseded
        if step % TOLD_EVERY == 0:
            self.controls.say_state(f"Playing {scenario.planner}: step {step} of at most {scenario.task.max_steps}")

    def _show(self, recordings: list[Recording]) -> None:
        """Replace the recordings on the page."""
        look, count = recordings[0].look, len(recordings)
        with self._scene, self.server.atomic():
            for stage in self._stages:
                stage.remove()
            moved = len(self._stages) != count
            places = places_of(look, count)
            self._stages = [
                Stage(self.server, f"/world_{number}", recording, place)
                for number, (recording, place) in enumerate(zip(recordings, places, strict=True))
            ]
            self.recordings, self.step = recordings, 0.0
            self.controls.show_recordings(recordings)
            self._push()
        if moved:
            self._place_cameras(count)

    def _place_cameras(self, count: int) -> None:
        """Place every client's camera so that ``count`` worlds are visible."""
        place, lookat, _ = camera_of(self.recordings[0].look)
        place = lookat + (1.0 if count == 1 else WIDER) * (place - lookat)
        for camera in (self.server.initial_camera, *(client.camera for client in self.server.get_clients().values())):
            # A client that has just connected has no camera yet, and starts with the initial one.
            with contextlib.suppress(AssertionError):
                camera.position, camera.look_at, camera.fov = place, lookat, FIELD_OF_VIEW

    def _play(self) -> None:
        """Advance with the clock while the page plays."""
        before = time.monotonic()
        while not self._closed:
            time.sleep(max(0.0, before + 1.0 / RATE - time.monotonic()))
            now = time.monotonic()
            passed, before = now - before, now
            if self.playing and self.recordings:
                with self._scene:
                    self._advance(passed)

    def _advance(self, seconds: float) -> None:
        """Advance by ``seconds`` of the clock, and stop at the end."""
        if self.step >= self.length:
            self.controls.pause()
            return
        control_step = self.recordings[0].scenario.task.control_step
        self.step = min(self.step + seconds * self.controls.speed / control_step, float(self.length))
        self._push()

    def _push(self) -> None:
        """Send the present step to all clients."""
        step = int(self.step)
        with self.server.atomic():
            for stage in self._stages:
                stage.show(step, self.controls.hidden)
            self.controls.show_step(self.recordings, step)
        self.pushed += 1


def local_server(port: int) -> Any:
    """A viser server that listens on `HOST` only, without a tunnel to the outside; raises `InputError`."""
    try:
        import mjviser  # noqa: F401
        import viser
    except ImportError as error:
        raise InputError("the page needs its extra: pip install 'torchdyn-plan[view]'") from error

    class LocalServer(viser.ViserServer):
        """Opens no tunnel to the outside, which any page of the browser could ask for."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Refuses."""

    try:
        server = LocalServer(host=HOST, port=port, label="torchdyn-plan", verbose=False)
    except (OSError, RuntimeError) as error:
        raise InputError(f"port {port} cannot be served: {error}") from error
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    # Brighter than this the colours of marks fade.
    server.scene.configure_environment_map(environment_intensity=0.2)
    return server


def serve(scenarios: Sequence[Scenario], *, port: int = 8080, show: Callable[[str], object] = print) -> None:
    """Serve the page until it is interrupted; ``show`` says where it is. Raises as `Page`."""
    page = Page(scenarios, port=port)
    try:
        show(f"{page.address}  (Ctrl-C ends it)")
        threading.Event().wait()
    finally:
        page.close()
