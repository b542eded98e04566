import dataclasses
import json
import math
import statistics

import pytest
import torch

from torchdyn_plan.errors import InputError
from torchdyn_plan.evaluation.plots import plot_results, plot_sweep
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import NO_CAUSE, EpisodeOutcomes, failure_shares, over_repeats, summarize
from torchdyn_plan.tasks.trapper.task import TASK, TrapperSettings

CAUSES = TASK.causes


def outcomes(count=6, seed=0):
    random = torch.Generator().manual_seed(seed)
    success, solvable, touched, pocketed, promised = (torch.rand(count, generator=random) < 0.5 for _ in range(5))
    cause = torch.randint(len(CAUSES), (count,), generator=random).masked_fill(success, NO_CAUSE)
    return EpisodeOutcomes(
        success=success,
        steps=torch.where(success, 90, -1),
        replans=torch.arange(count),
        solvable=solvable,
        flags={"pocketed": pocketed, "touched": touched},
        evidence={"promised": promised, "forecast_error": 0.1 * torch.rand(count, generator=random)},
        cause=cause,
        causes=CAUSES,
        seconds=1.5,
    )


def row(episodes=None, planner="corner", **settings):
    return summarize(
        episodes or outcomes(), task=TASK, planner=planner, static="ik", settings=TrapperSettings(**settings)
    )


def test_outcomes_survive_a_file():
    before = outcomes()
    content = json.loads(json.dumps(before.to_json(TASK), allow_nan=False))
    after = EpisodeOutcomes.from_json(content, TASK)
    for name in ("success", "steps", "replans", "solvable", "cause"):
        one, other = getattr(before, name), getattr(after, name)
        assert one.dtype == other.dtype
        assert torch.equal(one, other), name
    again = after.to_json(TASK)
    assert again == content
    assert {name is None for name in content["cause"]} == {True, False}


def test_files_speak_the_tasks_words():
    content = outcomes().to_json(TASK)
    names = {"trapped", "steps", "replans", "solvable", "touched", "pocketed", "promised", "forecast_error"}
    assert set(content) == names | {"cause", "seconds"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.pop("trapped"), "episode outcomes lack trapped"),
        (
            lambda content: content.update(trapped=[None, *content["trapped"][1:]]),
            r"trapped\[0\] must be true or false, got None",
        ),
        (lambda content: content.update(seconds=None), "seconds must be a finite number, got None"),
        (lambda content: content.update(cause=[["late"]] * 6), r"cause\[0\] must be a text or null"),
        (lambda content: content.update(steps=[2**80] * 6), r"steps\[0\] must be a whole number"),
        (lambda content: content.update(replans=[-2] * 6), r"replans\[0\] must be a number >= 0, got -2"),
        (lambda content: content.update(pocketed=[True, math.nan] * 3), "pocketed must be"),
        (lambda content: content.update(forecast_error=[2**70] * 6), "forecast_error must be"),
        (lambda content: content.update(forecast_error=[1e308] * 6), "forecast_error must be finite, got 6"),
        (lambda content: content.update(cause=["rain"] * 6), "name unknown causes: rain"),
        (lambda content: content.update(steps=[1, 2]), r"outcomes.steps must have shape \(E,\) = \(6,\), got \(2,\)"),
        (lambda content: content.update(solvable=[1] * 6), r"solvable\[0\] must be true or false, got 1"),
    ],
)
def test_a_damaged_file_is_refused(change, message):
    content = outcomes().to_json(TASK)
    change(content)
    with pytest.raises(InputError, match=message):
        EpisodeOutcomes.from_json(content, TASK)


def test_merged_outcomes_are_one_run():
    parts = outcomes(), outcomes(seed=1)
    both = EpisodeOutcomes.merge(parts)
    assert both.seconds == 3.0
    assert both.cause.tolist() == [code for part in parts for code in part.cause.tolist()]
    for name in ("pocketed", "touched"):
        assert torch.equal(both.flags[name], torch.cat([part.flags[name] for part in parts]))
    assert torch.equal(both.evidence["promised"], torch.cat([part.evidence["promised"] for part in parts]))


def test_shares_are_of_all_episodes():
    late, early = CAUSES.index("late"), CAUSES.index("early_contact")
    codes = torch.tensor([NO_CAUSE, NO_CAUSE, 0, early, early, late, NO_CAUSE, late])
    found = dataclasses.replace(outcomes(8), cause=codes)
    expected = dict.fromkeys(CAUSES, 0.0) | {"unreachable": 1 / 8, "early_contact": 2 / 8, "late": 2 / 8}
    assert failure_shares(found) == expected


def test_shares_and_success_add_up():
    found = outcomes(1000)
    assert sum(failure_shares(found).values()) + found.success.double().mean().item() == pytest.approx(1.0)


def test_a_table_names_what_rows_share_and_what_tells_them_apart():
    alone = format_table(TASK, [row(), row(planner="pursuit")])
    title, _, head, *_ = alone.splitlines()
    assert title.startswith("trapper, static planner ik, velocity 3 m/s, friction 0 N, 6 episodes, ")
    assert title.endswith("% solvable")
    for word in ("steps to trap", "paper", "planner too slow", "late"):
        assert word in head
    several = format_table(TASK, [row(velocity=value) for value in (1.0, 2.0)])
    title, _, head, _, first, second = several.splitlines()
    assert title == "trapper, static planner ik, friction 0 N, 6 episodes"
    assert head.split()[:2] == ["planner", "velocity"]
    assert (first.split()[1], second.split()[1]) == ("1", "2")


def test_figures_are_drawn_with_whatever_planners_and_settings(tmp_path):
    rows = [row(outcomes(seed=seed), planner, velocity=seed) for seed in range(3) for planner in ("corner", "mine")]
    plot_sweep(TASK, rows, "velocity", tmp_path / "sweep.png")
    plot_results(TASK, rows[:2], tmp_path / "results.svg")
    assert (tmp_path / "sweep.png").stat().st_size > 10_000
    drawn = (tmp_path / "results.svg").read_text()
    assert drawn.startswith("<?xml")


def test_a_setting_nobody_could_solve_leaves_a_gap(tmp_path):
    none = dataclasses.replace(outcomes(), solvable=torch.zeros(6, dtype=torch.bool))
    rows = [row(none, velocity=1.0)]
    assert rows[0].success_solvable is None
    assert "–" in format_table(TASK, rows)
    plot_sweep(TASK, rows, "velocity", tmp_path / "sweep.png")
    plot_results(TASK, rows, tmp_path / "results.png")


def test_a_row_tells_how_its_repeats_differ_as_the_paper_does():
    parts = [outcomes(40, seed) for seed in range(3)]
    row = summarize(EpisodeOutcomes.merge(parts), task=TASK, planner="corner", static="ik", settings=TASK.settings())
    assert (row.repeats, row.success_repeats) == (1, None)
    told = over_repeats(row, parts)
    rates = [float(part.success.double().mean()) for part in parts]
    assert told.repeats == 3
    assert told.success_repeats == pytest.approx((statistics.mean(rates), statistics.stdev(rates)))
    assert told.success_repeats[0] == pytest.approx(row.success)
    hopeless = dataclasses.replace(parts[0], solvable=torch.zeros(40, dtype=torch.bool))
    assert over_repeats(row, [hopeless, *parts[1:]]).success_solvable_repeats is None
    assert over_repeats(row, parts[:1]).success_repeats is None
