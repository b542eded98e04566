"""The page's control panel and its messages: one method for each folder of the panel."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchdyn_plan.envs.sensor import Sensor
from torchdyn_plan.errors import TorchdynPlanError
from torchdyn_plan.evaluation.study import SPLITS
from torchdyn_plan.evaluation.tracks import NO_TRACK, TRACKS, track_named
from torchdyn_plan.planners import Track
from torchdyn_plan.view.marks import LAYERS
from torchdyn_plan.view.recording import LAST_EPISODE, Recording, Scenario
from torchdyn_plan.view.words import clock, outcome, plan_line

if TYPE_CHECKING:
    from torchdyn_plan.view.page import Page

NO_PLANNER = "none"
SPEEDS = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/10": 0.1}
"""Playback speeds by label: 1 is real time."""
SENSOR_RANGES: Mapping[str, tuple[float, float, str]] = {
    "rate": (240.0, 10.0, "Measurements a second [Hz], 0 for one at each control step"),
    "noise": (0.03, 0.001, "Standard deviation along each axis [m]"),
    "latency": (0.1, 0.004, "Time from a measurement to its arrival [s]"),
    "jitter": (0.02, 0.001, "Standard deviation of the time of a measurement [s]"),
    "dropout": (0.9, 0.05, "Share of lost measurements"),
    "quantisation": (0.03, 0.001, "Measurements are rounded to multiples of this [m], 0 for no rounding"),
}
"""Largest value, step and hint of each number of a `Sensor`; all start at 0."""


class Controls:
    """The page's control panel."""

    def __init__(self, server: Any, scenarios: Sequence[Scenario], page: Page) -> None:
        """Build the panel of the task of ``scenarios``, with their choices."""
        self.gui, self.page, self._first = server.gui, page, scenarios[0]
        self.hidden: set[str] = set()
        self.speed = SPEEDS["1/4"]
        self._state = self.gui.add_markdown("Starting …")
        self._said = self.gui.add_markdown("")
        self._playback()
        self._who(scenarios)
        self._world()
        self._sensing()
        self._shown()

    def _playback(self) -> None:
        with self.gui.add_folder("Playback"):
            self._play = self.gui.add_button("Pause")
            self._play.on_click(lambda _: self.pause() if self.page.playing else self.play())
            steps = self.gui.add_button_group("Step", ("|<", "<", ">", ">|"))
            steps.on_click(lambda event: self._jump(event.target.value))
            self._scrubber = self.gui.add_slider("Control step", 0, 1, 1, 0)
            self._scrubber.on_update(self._scrub)
            speed = self.gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1/4")
            speed.on_update(lambda _: setattr(self, "speed", SPEEDS[speed.value]))

    def _who(self, scenarios: Sequence[Scenario]) -> None:
        task, names = self._first.task, tuple(self._first.task.planners)
        beside = scenarios[1].planner if len(scenarios) > 1 else NO_PLANNER
        with self.gui.add_folder("Planners"):
            self._left = self._wanted(self.gui.add_dropdown("Planner", names, initial_value=self._first.planner))
            self._right = self._wanted(self.gui.add_dropdown("Beside it", (NO_PLANNER, *names), initial_value=beside))
            statics, static = tuple(task.static_planners), self._first.static or task.default_static
            self._static = self._wanted(self.gui.add_dropdown("Static planner", statics, initial_value=static))

    def _world(self) -> None:
        first, chosen = self._first, self._first.chosen
        with self.gui.add_folder("Episode"):
            number = self.gui.add_number("Episode", first.episode, min=0, max=LAST_EPISODE, step=1)
            self._episode = self._wanted(number)
            self._seed = self._wanted(self.gui.add_number("Seed", first.seed, min=0, step=1))
            self._split = self._wanted(self.gui.add_dropdown("Split", SPLITS, initial_value=first.split))
            self._settings = {
                one.name: self._wanted(self._setting(one, getattr(chosen, one.name)))
                for one in dataclasses.fields(chosen)
            }

    def _setting(self, field: Any, value: Any) -> Any:
        """A slider over the range of a sweep, a choice, or a number."""
        about, name = field.metadata, field.name.replace("_", " ")
        label = f"{name} [{about['unit']}]" if about.get("unit") else name
        if about.get("choices"):
            return self.gui.add_dropdown(label, tuple(about["choices"]), initial_value=value, hint=about.get("text"))
        if not isinstance(value, (int, float)):
            return self.gui.add_text(label, value, hint=about.get("text"))
        if about.get("sweep"):
            low, high = min(*about["sweep"], value), max(*about["sweep"], value)
            step = (high - low) / 50.0
            return self.gui.add_slider(label, float(low), float(high), step, float(value), hint=about.get("text"))
        bounds = {"min": about.get("minimum"), "max": about.get("maximum")}
        return self.gui.add_number(label, value, hint=about.get("text"), **bounds)

    def _sensing(self) -> None:
        sensor = self._first.sensor or Sensor()
        with self.gui.add_folder("Sensor", expand_by_default=False):
            self._sensor = {}
            for name, (most, step, hint) in SENSOR_RANGES.items():
                value = float(getattr(sensor, name) or 0.0)
                slider = self.gui.add_slider(name, 0.0, max(most, value), step, value, hint=hint)
                self._sensor[name] = self._wanted(slider)
            names, track = (NO_TRACK, *TRACKS), self._first.track
            known = next((name for name, kind in TRACKS.items() if isinstance(track, kind)), NO_TRACK)
            self._track = self._wanted(self.gui.add_dropdown("Track", names, initial_value=known))

    def _shown(self) -> None:
        with self.gui.add_folder("Shown", expand_by_default=False):
            for name in LAYERS[:-2]:
                box = self.gui.add_checkbox(name, True)
                box.on_update(lambda event, name=name: self._hide(name, not event.target.value))

    def _hide(self, name: str, hidden: bool) -> None:
        self.hidden = self.hidden | {name} if hidden else self.hidden - {name}
        self.page.go_to(self.page.step)

    def _wanted(self, handle: Any) -> Any:
        """``handle``, with every change requesting a new recording."""
        handle.on_update(lambda _: self._ask())
        return handle

    def _ask(self) -> None:
        """Request a recording with the panel's settings; an invalid combination is reported on the page."""
        try:
            scenarios = self.scenarios()
        except TorchdynPlanError as error:
            self.say_error(str(error))
            return
        self.say_state("Loading …")
        self.page.want(scenarios)

    def scenarios(self) -> list[Scenario]:
        """The panel's settings; raises `InputError` for an invalid combination."""
        first = self._first
        numbers: dict[str, Any] = {name: slider.value for name, slider in self._sensor.items()}
        # Rate 0 stands for one measurement at each control step.
        numbers["rate"] = numbers["rate"] or None
        sensor = Sensor(**numbers)
        settings = {name: handle.value for name, handle in self._settings.items()}
        changes: dict[str, Any] = {
            "static": self._static.value,
            "episode": int(self._episode.value),
            "seed": int(self._seed.value),
            "split": self._split.value,
            "settings": first.task.default_settings(**settings),
            "sensor": None if sensor.is_exact else sensor,
            "track": self._chosen_track(sensor),
        }
        names = [self._left.value, *([] if self._right.value == NO_PLANNER else [self._right.value])]
        return [dataclasses.replace(first, planner=name, **changes) for name in names]

    def _chosen_track(self, sensor: Sensor) -> Track | None:
        """The given track if it is still selected for the same sensor, otherwise a new one by its name."""
        first, name = self._first, self._track.value
        if name != NO_TRACK and isinstance(first.track, TRACKS[name]) and sensor == (first.sensor or Sensor()):
            return first.track
        return track_named(name, sensor)

    def play(self) -> None:
        """Play, from the beginning if the end is shown."""
        if self.page.step >= self.page.length:
            self.page.go_to(0)
        self.page.playing, self._play.label = True, "Pause"

    def pause(self) -> None:
        """Pause."""
        self.page.playing, self._play.label = False, "Play"

    def _jump(self, word: str) -> None:
        self.pause()
        now = int(self.page.step)
        self.page.go_to({"|<": 0, "<": now - 1, ">": now + 1, ">|": self.page.length}[word])

    def _scrub(self, event: Any) -> None:
        # The page itself also moves the slider; only a user's event has a client.
        if event.client is not None:
            self.pause()
            self.page.go_to(self._scrubber.value)

    @property
    def says(self) -> str:
        """The page's state or error message."""
        return self._state.content

    def say_state(self, text: str) -> None:
        """Show what the page is doing."""
        self._state.content = text

    def say_error(self, text: str) -> None:
        """Show an error until something else is shown."""
        self.pause()
        self._state.content = f"**Error.** {text}"

    def show_recordings(self, recordings: Sequence[Recording]) -> None:
        """Show new ``recordings`` from their beginning."""
        task, first = recordings[0].scenario.task, recordings[0].scenario
        self._scrubber.max = max(recording.length for recording in recordings)
        self.say_state(f"{task.name}, episode {first.episode}")
        self.play()

    def show_step(self, recordings: Sequence[Recording], step: int) -> None:
        """Show the state at ``step``."""
        if int(self._scrubber.value) != step:
            self._scrubber.value = step
        self._said.content = "\n\n".join(describe(recording, step) for recording in recordings)


def describe(recording: Recording, step: int) -> str:
    """State of a recording at ``step``, and its outcome once it has ended."""
    now, name = min(step, recording.length), recording.scenario.planner.replace("_", " ")
    plan, plans = plan_line(recording, now), int(recording.replans[now])
    if now == recording.length:
        return f"**{name}**: **{outcome(recording)}**, {plans} plans"
    return f"**{name}** at {clock(recording, now)}: {plan}, {plans} plans"
