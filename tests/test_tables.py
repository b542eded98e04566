"""The tables of the pages are those of the committed results: every number, to its last printed digit."""

import json
import re
from pathlib import Path

import pytest

from torchdyn_plan.evaluation.curves import rate_at
from torchdyn_plan.tasks import load_task

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
NUMBER = re.compile(r"[+-]?\d*\.?\d+")


def rows_of(name):
    return json.loads((RESULTS / name).read_text())["rows"]


def rows_in(folder):
    """Rows of a sweep, and of the separate one of *wait and drop*."""
    return [*rows_of(f"{folder}/results.json"), *rows_of(f"{folder}/wait_and_drop.json")]


def table(page, head):
    """The table on a page whose head begins with ``head``: the first cell of each line, the numbers of the others."""
    lines = (ROOT / page).read_text().splitlines()
    (start,) = (number for number, line in enumerate(lines) if line.startswith(f"| {head}"))
    found = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        first, *cells = (cell.strip().strip("*") for cell in line.strip("|").split("|"))
        # A hyphen between two numbers is a range, and no sign.
        text = " ".join(re.sub(r"(?<=\d)[–-](?=\d)", " ", cell) for cell in cells)
        found.append((first.strip(), NUMBER.findall(text.replace("–", " "))))
    assert found, head
    return found


def agree(printed, expected, where):
    """Whether numbers are those expected, rounded to the digits that are printed."""
    assert len(printed) == len(expected), (where, printed, expected)
    for text, value in zip(printed, expected, strict=True):
        digits = len(text.partition(".")[2])
        assert abs(float(text) - value) <= 0.5 * 10**-digits + 1e-9, (where, text, value)


def at(rows, planner, **settings):
    """The row of a planner at some settings."""
    (row,) = (
        row
        for row in rows
        if row["planner"] == planner and all(row["settings"][name] == value for name, value in settings.items())
    )
    return row


def test_velocity():
    rows = rows_in("velocity")
    order = ("pursuit", "corner", "corner_never", "oracle", "recorded_oracle", "exact", "wait_and_drop")
    for first, printed in table("docs/results.md", "velocity | solvable | target pursuit | corner | corner, arrivals"):
        expected = []
        for planner in order:
            row = at(rows, planner, velocity=float(first.split()[0]))
            expected += [row["solvable"]] if planner == "pursuit" else []
            expected.append(row["success_solvable"])
            expected += [row["paper_success_solvable"]] if planner in ("pursuit", "corner", "oracle") else []
        agree(printed, expected, first)


def test_ceiling():
    ceilings, rows = {row["velocity"]: row for row in rows_of("ceiling.json")}, rows_in("velocity")
    for first, printed in table("docs/results.md", "velocity | balls | ceiling"):
        velocity = float(first.split()[0])
        row, reached = ceilings[velocity], at(rows, "wait_and_drop", velocity=velocity)["success_solvable"]
        agree(printed, [row["solvable"], row["ceiling"], *row["ceiling_ci"], reached / row["ceiling"]], first)


def test_release():
    rows = [row for row in rows_of("final-0.2.0.json") if "velocity" in row]
    for first, printed in table("docs/results.md", "velocity | balls | *wait and drop* | *untrained*"):
        of = [row for row in rows if row["velocity"] == float(first.split()[0])]
        rates = (rate for row in of for rate in (row["success_solvable"], *row["success_solvable_ci"]))
        agree(printed, [of[0]["solvable"], *rates], first)


def test_sensors_in_the_readme():
    sensors = ("2 mm, 250 Hz", "5 mm, 60 Hz, 20 ms late", "5 mm, 30 Hz, 5 % lost, 3 ms jitter")
    exact, seen = rows_in("velocity"), rows_of("sensors.json")
    for first, printed in table("README.md", "ball | exact"):
        velocity = float(first.split()[0])
        of = {(row["velocity"], row["sensor"]): row for row in seen if row["planner"] == "wait_and_drop"}
        rows = [at(exact, "wait_and_drop", velocity=velocity), *(of[velocity, sensor] for sensor in sensors)]
        agree(printed, [100 * row["success_solvable"] for row in rows], first)


def test_sensors():
    rows, sensor = rows_of("sensors.json"), ""
    for first, (velocity, *printed) in table("docs/sensors.md", "sensor | m/s"):
        sensor = first or sensor
        of = {row["planner"]: row for row in rows if (row["sensor"], row["velocity"]) == (sensor, float(velocity))}
        planners = ("wait_and_drop", "exact_forecast", "billiard", "constant_velocity")
        agree(printed, [of[name]["success_solvable"] for name in planners if name in of], (sensor, velocity))


def test_trainings_with_noise():
    rows = [row for row in rows_of("trainings_noisy.json") if "over" in row and "velocity" in row]
    for first, printed in table("docs/sensors.md", "five trainings"):
        of = [row for row in rows if row["sensor"] == first]
        assert [row["velocity"] for row in of] == [1.0, 3.0, 5.0]
        agree(printed, [x for row in of for x in (row["interquartile_mean"], *row["interquartile_mean_ci"])], first)


def test_velocity_with_the_policy():
    rows, ik = rows_in("policy/velocity"), rows_in("velocity")
    for first, printed in table("docs/results.md", "velocity | solvable | target pursuit | corner | oracle"):
        velocity, expected = float(first.split()[0]), []
        for planner in ("pursuit", "corner", "oracle"):
            row = at(rows, planner, velocity=velocity)
            expected += [row["solvable"]] if planner == "pursuit" else []
            expected += [row["success_solvable"], row["paper_success_solvable"]]
        expected.append(at(rows, "wait_and_drop", velocity=velocity)["success_solvable"])
        expected.append(at(ik, "corner", velocity=velocity)["success_solvable"])
        expected.append(at(ik, "wait_and_drop", velocity=velocity)["success_solvable"])
        agree(printed, expected, first)


def test_friction_in_the_text():
    text = (ROOT / "docs" / "results.md").read_text()
    rows = rows_in("friction")
    (found,) = re.findall(r"friction sweep at 3 m/s \(0 to 9\.5 N\)(.*?)\(`torchdyn", text, re.DOTALL)
    values = [0.0, 2.5, 5.0, 7.5, 9.5]
    expected = [
        100 * at(rows, planner, friction=value)["success_solvable"]
        for planner in ("wait_and_drop", "corner", "oracle", "pursuit")
        for value in values
    ]
    agree(NUMBER.findall(found), expected, "friction")


def test_braking():
    rows = {row["drop"]: row for row in rows_of("braking.json")}
    names = (
        "as it is",
        "follows from the first step",
        "aims 10 steps ahead",
        "aims where the ball is",
        "stops 1.2 cm above the table",
        "stops 3 cm above the table",
        "brakes much earlier",
    )
    for name, (first, printed) in zip(names, table("docs/results.md", "drop | of solvable"), strict=True):
        row = rows[name]
        change = [100 * row["change"], *(100 * end for end in row["change_ci"])] if "change" in row else []
        expected = [100 * row["success_solvable"], *change, row["peak"], 100 * row["above"]]
        agree(printed, expected, first)


def test_ablation():
    rows = rows_of("ablation.json")
    names = list(dict.fromkeys(row["variant"] for row in rows))
    for name, (first, printed) in zip(names, table("docs/results.md", "switched | 3 m/s"), strict=True):
        expected, plans = [], []
        for velocity in (3.0, 5.0):
            (row,) = (row for row in rows if row["variant"] == name and row["velocity"] == velocity)
            expected += [100 * row["success_solvable"], *(100 * end for end in row["success_solvable_ci"])]
            expected += [] if name == "wait_and_drop" else [100 * one for one in (row["change"], *row["change_ci"])]
            plans.append(row["replans"])
        agree(printed, expected + plans, first)


def test_schedules():
    rows = rows_of("schedules.json")
    names = ("every 5", "every 10", "every 25", "paper", "events, up to 50", "events, up to 50, 1 mm")
    for name, (first, printed) in zip(names, table("docs/results.md", "schedule of"), strict=True):
        three, five = (
            next(row for row in rows if row["schedule"] == name and row["velocity"] == velocity)
            for velocity in (3.0, 5.0)
        )
        both = [(three[name] + five[name]) / 2 for name in ("replans", "looks", "planning_ms")]
        agree(printed, [100 * three["success_solvable"], 100 * five["success_solvable"], *both], first)


def test_being_late():
    rows = rows_of("latency/results.json")
    for first, printed in table("docs/latency.md", "planning takes"):
        delay, compensated = int(first.split()[0]), "not" not in first
        expected = []
        for velocity in (3.0, 5.0):
            (row,) = (
                row
                for row in rows
                if (row["velocity"], row["latency_ms"], row["compensate"]) == (velocity, delay, compensated)
            )
            expected += [100 * row["success_solvable"]]
            expected += [100 * one for one in (row["change"], *row["change_ci"])] if delay else []
        agree(printed, expected, first)


def test_fetch_reach():
    sweep, policy = rows_of("reach/results.json"), rows_of("reach/policy/results.json")
    lines = dict(table("docs/results.md", "metres a step"))
    velocities = (0.001, 0.011, 0.021, 0.031, 0.041, 0.051)
    for name, planner in (("exact search", "exact"), ("corner search", "corner"), ("target pursuit", "pursuit")):
        agree(lines[name], [at(sweep, planner, velocity=one)["success"] for one in velocities], name)
    agree(lines["DHER"], [at(sweep, "dher", velocity=one)["success"] for one in velocities], "DHER")
    of_policy = [row for row in policy if row["planner"] == "exact" and row["velocity"] in velocities]
    agree(lines["exact search, with the policy"], [row["success"] for row in of_policy], "policy")
    agree(lines["ceiling"], [at(sweep, "exact", velocity=one)["solvable"] for one in velocities], "ceiling")
    task = load_task("fetch_reach")
    assert task.paper is not None
    paper, theirs = task.paper(), []
    for velocity in velocities:
        settings = task.default_settings(velocity=velocity)
        theirs += [min(1.0, paper.rate(name, "", settings, solvable=False) or 0.0) for name in ("corner", "dher")]
    agree(lines["the paper's planner, DHER"], theirs, "paper")


def test_search_for_the_scene():
    rows = rows_of("paper_scene.json")
    for row, (first, printed) in zip(rows, table("docs/reproduction.md", "changed | mean error"), strict=True):
        agree(printed, [row["error"], row["worst"]], first)


SCENE_VALUES = {"velocity": (1.0, 2.0, 3.0, 4.0, 5.0), "friction": (0.0, 2.5, 5.0, 7.5, 9.5)}
PAPERS = ("pursuit", "corner", "oracle")


def paper_at(planner, over, value, *, solvable):
    """The paper's success rate with IK, by its curve over a setting."""
    task = load_task("trapper")
    assert task.paper is not None
    others = {"velocity": {"friction": 0.0}, "friction": {"velocity": 3.0}}[over]
    curve = task.paper().curve(planner, "ik", over, task.default_settings(**others), solvable=solvable)
    assert curve is not None
    found = rate_at(curve, value)
    assert found is not None
    return found


def paper_solvable(over, value):
    """The paper's share of solvable episodes: its success over all episodes by that over solvable ones, on average."""
    shares = [paper_at(one, over, value, solvable=False) / paper_at(one, over, value, solvable=True) for one in PAPERS]
    return sum(shares) / len(shares)


@pytest.mark.parametrize(
    ("head", "over"), [("m/s | solvable | pursuit | corner | oracle |", "velocity"), ("friction loss", "friction")]
)
def test_scene_of_the_paper(head, over):
    rows = rows_of(f"paper_{over}/results.json")
    text = (ROOT / "docs" / "reproduction.md").read_text()
    lines = text[text.index(f"| {head}") :].splitlines()[2:7]
    for value, line in zip(SCENE_VALUES[over], lines, strict=True):
        first, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        assert float(first) == value
        expected = [at(rows, "corner", **{over: value})["solvable"], paper_solvable(over, value)]
        for planner in PAPERS:
            row = at(rows, planner, **{over: value})
            theirs = paper_at(planner, over, value, solvable=True)
            expected += [row["success_solvable"], row["success_solvable_repeats"][1], theirs]
        agree(NUMBER.findall(" ".join(cells)), expected, line)


def test_distances_from_the_paper():
    lines = dict(table("docs/reproduction.md", "distance from the paper"))
    for over, values in SCENE_VALUES.items():
        rows, expected = rows_of(f"paper_{over}/results.json"), []
        for planner in PAPERS:
            ours = {value: at(rows, planner, **{over: value})["success_solvable"] for value in values}
            off = [abs(ours[value] - paper_at(planner, over, value, solvable=True)) for value in values]
            expected += [sum(off) / len(off), max(off)]
        shares = {value: at(rows, "corner", **{over: value})["solvable"] for value in values}
        off = [abs(shares[value] - paper_solvable(over, value)) for value in values]
        agree(lines[f"over {over}"], [*expected, sum(off) / len(off), max(off)], over)


def test_scene_of_the_paper_with_the_policy():
    rows = rows_in("paper_policy")
    for first, printed in table("docs/reproduction.md", "m/s | solvable | pursuit | corner | oracle | wait and drop"):
        expected = []
        for planner in ("pursuit", "corner", "oracle"):
            row = at(rows, planner, velocity=float(first))
            expected += [row["solvable"]] if planner == "pursuit" else []
            expected += [row["success_solvable"], row["paper_success_solvable"]]
        agree(printed, [*expected, at(rows, "wait_and_drop", velocity=float(first))["success_solvable"]], first)


def test_wait_and_drop_in_the_scene_of_the_paper():
    text = (ROOT / "docs" / "reproduction.md").read_text()
    (found,) = re.findall(r"\*Wait and drop\* traps (.*?) of the solvable", text, re.DOTALL)
    rows = rows_of("paper_wait_and_drop/results.json")
    rates = [at(rows, "wait_and_drop", velocity=value)["success_solvable"] for value in SCENE_VALUES["velocity"]]
    agree(NUMBER.findall(found), rates, "wait and drop")


def test_deviations():
    rows = rows_of("deviations.json")
    deviations = list(dict.fromkeys(row["deviation"] for row in rows))
    printed_rows = table("docs/reproduction.md", "| pursuit, ours")
    assert len(printed_rows) == len(deviations)
    for deviation, (first, printed) in zip(deviations, printed_rows, strict=True):
        expected = []
        for planner in ("pursuit", "corner"):
            for way in ("ours", "paper"):
                mine = [
                    row for row in rows if (row["deviation"], row["planner"], row["way"]) == (deviation, planner, way)
                ]
                # Pursuit reads no forecast.
                if planner == "corner" or "forecaster" not in deviation:
                    expected += [row["success_solvable"] for row in mine]
        agree(printed, expected, first)


def test_catch():
    rows = rows_of("catch.json")
    lines = table("docs/catch.md", "planner | sensor")
    assert len(lines) == len(rows)
    for first, printed in lines:
        name = re.findall(r"\w+", first)[0]
        sensor = "3 mm, 60 Hz" if printed[:2] == ["3", "60"] else "exact"
        (row,) = (row for row in rows if (row["planner"], row["sensor"]) == (name, sensor))
        measured = [3, 60] if sensor != "exact" else []
        agree(printed, [*measured, row["success_solvable"], *row["success_solvable_ci"]], (name, sensor))


def test_catch_of_other_balls():
    rows = rows_of("catch.json") + rows_of("catch_drag.json")
    for first, printed in table("docs/catch.md", "drag [1/m]"):
        found = {
            row["planner"]: row["success_solvable"]
            for row in rows
            if row["drag"] == float(first.split()[0]) and row["sensor"] == "3 mm, 60 Hz"
        }
        agree(printed, [found["meet"], found["learned"]], first)


def test_conveyor():
    rows = rows_of("conveyor.json")
    lines = table("docs/conveyor.md", "planner | 0.2 m/s")
    for planner, (first, printed) in zip(("pursuit:gain", "pursuit", "meet", "learned"), lines, strict=True):
        expected = []
        for speed in (0.2, 0.35, 0.6):
            (row,) = (row for row in rows if (row["planner"], row["speed"]) == (planner, speed))
            expected += [row["taken_of_solvable"], *([row["seconds_to_clear"]] if row["taken_of_solvable"] else [])]
        agree(printed, expected, first)
    several = rows_of("conveyor_parts.json")
    for first, printed in table("docs/conveyor.md", "| 0.2 m/s"):
        planner, entry = first.split(": ")
        of = [row for row in several if row["planner"] == planner.strip("*`")]
        agree(printed, [row[{"parts": "taken_of_solvable"}.get(entry, "episodes_cleared")] for row in of], first)


def test_a_number_that_is_off_is_found():
    agree(["93.1", ".45"], [93.0986, 0.4535], "good")
    with pytest.raises(AssertionError, match=r"93\.2"):
        agree(["93.2"], [93.0986], "bad")
    with pytest.raises(AssertionError):
        agree(["93.1"], [93.0986, 1.0], "short")
