import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchdyn_plan.evaluation.evidence import Evidence
from torchdyn_plan.evaluation.plots import plot_results, plot_sweep
from torchdyn_plan.evaluation.report import format_table
from torchdyn_plan.evaluation.results import EpisodeOutcomes, ResultRow, summarize

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
PUBLISHED = [RESULTS / name / "results.json" for name in ("friction", "velocity")]


def outcomes(count=6, seed=0):
    random = torch.Generator().manual_seed(seed)
    flags = [torch.rand(count, generator=random) < 0.5 for _ in range(7)]
    clues = Evidence(
        flags[4], flags[4] & flags[5], 0.1 * torch.rand(count, generator=random),
        torch.randint(-20, 20, (count,), generator=random), torch.where(flags[1], 7, -1), flags[6],
    )  # fmt: skip
    named = dict(zip(("trapped", "touched", "pocketed", "solvable"), flags[:4], strict=True))
    steps = torch.where(flags[0], 90, -1)
    return EpisodeOutcomes(**named, steps=steps, replans=steps.clamp_min(3), seconds=1.5, evidence=clues)


def assert_same(one, other):
    for name in ("trapped", "touched", "pocketed", "solvable", "steps", "replans", "cause"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    for clue, same in zip(one.evidence, other.evidence, strict=True):
        assert clue.dtype == same.dtype
        assert torch.equal(clue, same)


def test_outcomes_survive_a_file():
    before = outcomes()
    content = json.loads(json.dumps(before.to_json(), allow_nan=False))
    assert_same(EpisodeOutcomes.from_json(content), before)
    assert {name is None for name in content["cause"]} == {True, False}


def test_merged_outcomes_are_one_run():
    parts = outcomes(), outcomes(seed=1)
    both = EpisodeOutcomes.merge(parts)
    assert both.seconds == 3.0
    assert both.cause.tolist() == [code for part in parts for code in part.cause.tolist()]


def test_outcomes_of_before_there_was_evidence_are_read():
    content = outcomes().to_json()
    old = {name: values for name, values in content.items() if name not in {*Evidence._fields, "cause"}}
    assert_same(EpisodeOutcomes.from_json(old), replace(outcomes(), evidence=Evidence.none(6)))


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.parent.name)
def test_published_results_are_read_whatever_their_causes(path, tmp_path):
    rows = [ResultRow(**row) for row in json.loads(path.read_text())["rows"]]
    table = format_table(rows)
    for name in rows[0].failures:
        assert name.replace("_", " ") in table
    plot_sweep(rows, path.parent.name, tmp_path / "sweep.png")
    plot_results(rows[:1], tmp_path / "results.png")


def test_a_table_of_old_and_new_results_has_all_their_causes():
    new = summarize(outcomes(), planner="meet", static="ik", velocity=3.0, friction=0.0)
    table = format_table([new, replace(new, failures={"too_early": 0.25})])
    head = table.splitlines()[2]
    assert head.index("unreachable") < head.index("late") < head.index("too early")
    assert table.splitlines()[-1].endswith("25 %")
