"""Shards of any task's data: what is in them, which are kept, and which are refused."""

import json
import re
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tests.training.toy_task import SIZES, TASK, record_arrivals, record_paths
from torchdyn_plan.errors import InputError, WeightsError
from torchdyn_plan.nets import Actor
from torchdyn_plan.tasks import load_task
from torchdyn_plan.training import shards
from torchdyn_plan.training.collect import SERIES, collect
from torchdyn_plan.training.windows import load_paths


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(shards, "SHARD", {"paths": 6, "arrivals": 24, "captures": 6})


def gather(out, what="paths", task=TASK, **settings):
    collect(task, what, out, **{"episodes": 10, "num_envs": 4, "num_threads": 1, **settings})
    return [load_file(file) for file in sorted(out.glob(f"{what}-*.safetensors"))]


def test_paths_are_recorded_in_blocks_of_the_episodes_that_run_side_by_side(tmp_path):
    asked = []

    def record(blocks, **how):
        asked.append([block.tolist() for block in blocks])
        assert how == {"seed": 3, "num_threads": 1}
        return record_paths(blocks, **how)

    gather(tmp_path, task=replace(TASK, record_paths=record), seed=3)
    assert asked == [[[0, 1, 2, 3], [4, 5]], [[6, 7, 8, 9]]]


def test_arrivals_are_recorded_a_sequence_a_block_with_a_seed_a_shard(tmp_path):
    asked = []

    def record(planner, **how):
        asked.append(how)
        return record_arrivals(planner, **how)

    gather(tmp_path, "arrivals", replace(TASK, record_arrivals=record), episodes=40, num_envs=8, seed=2)
    shared = {"num_envs": 8, "num_threads": 1}
    assert asked == [
        shared | {"sequences": 3, "seed": 2 * SERIES},
        shared | {"sequences": 2, "seed": 2 * SERIES + 1},
    ]


def test_a_description_says_what_was_asked_for(tmp_path):
    gather(tmp_path, "arrivals")
    about = json.loads((tmp_path / "arrivals-0.json").read_text())
    assert about["scene"] == "toy-1"
    assert about["versions"]
    assert about["arguments"] == {
        "task": "toy",
        "what": "arrivals",
        "out": str(tmp_path),
        "episodes": 10,
        "seed": 0,
        "num_envs": 4,
        "num_threads": 1,
        "static": "straight",
        "weights": None,
        "tracks": None,
    }


def test_shards_that_are_there_are_kept_but_not_one_that_was_cut_short(tmp_path):
    gather(tmp_path, episodes=8)
    first, last = sorted(tmp_path.glob("paths-*.safetensors"))
    with safe_open(first, "pt") as content:
        save_file({"mark": torch.ones(1)}, first, content.metadata())
    shards = gather(tmp_path, episodes=10)
    assert list(shards[0]) == ["mark"]
    assert len(shards[1]["length"]) == 4
    stamp = last.stat().st_mtime_ns
    gather(tmp_path, episodes=10, num_threads=2)
    assert last.stat().st_mtime_ns == stamp


def test_shards_of_another_collection_are_refused(tmp_path):
    gather(tmp_path, episodes=6)
    with pytest.raises(InputError, match=r"paths-0-000.* num_envs is 4 there, 5 here"):
        gather(tmp_path, episodes=6, num_envs=5)
    with pytest.raises(InputError, match="scene is toy-1 there, toy-2 here"):
        gather(tmp_path, task=replace(TASK, digest=lambda: "toy-2"), episodes=6)
    (tmp_path / "paths-0-000.safetensors").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"paths-0-000.*not a whole safetensors file"):
        gather(tmp_path, episodes=6)


def test_arrivals_of_another_planner_are_refused(tmp_path):
    gather(tmp_path, "arrivals")
    with pytest.raises(InputError, match="static is straight there, learned here"):
        gather(tmp_path, "arrivals", static="learned")


def test_a_persons_own_planner_drives_and_is_named(tmp_path):
    def own(td):
        return td

    shards = gather(tmp_path, "arrivals", planner=own, name="mine")
    assert all((shard["robot_state"] == 1.0).all() for shard in shards)
    assert json.loads((tmp_path / "arrivals-0.json").read_text())["arguments"]["static"] == "mine"


def test_weights_of_a_policy_are_taken_and_noted(tmp_path):
    one, other = (Actor(SIZES).save_pretrained(tmp_path / name / "policy") for name in ("one", "other"))
    gather(tmp_path, "arrivals", static="learned", weights=tmp_path / "one")
    about = json.loads((tmp_path / "arrivals-0.json").read_text())["arguments"]
    assert about["weights"] == str(one)
    gather(tmp_path, "arrivals", static="learned", weights=one)
    with pytest.raises(InputError, match=r"weights is .* there, .* here"):
        gather(tmp_path, "arrivals", static="learned", weights=other)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"what": "path"}, InputError, r"unknown kind of data 'path' \(did you mean 'paths'\?\)"),
        ({"what": "arrivals", "static": "ik"}, InputError, "unknown static planner of toy 'ik'"),
        ({"episodes": 0}, InputError, "episodes must be >= 1, got 0"),
        ({"seed": -1}, InputError, "seed must be >= 0"),
        ({"weights": "there"}, InputError, "weights are for the task's own static planner"),
        ({"what": "arrivals", "static": "learned", "weights": "nowhere"}, WeightsError, "no weights 'nowhere'"),
        ({"task": replace(TASK, record_paths=None)}, InputError, "toy records no paths"),
        ({"what": "arrivals", "task": replace(TASK, record_arrivals=None)}, InputError, "toy records no arrivals"),
        ({"what": "captures", "task": replace(TASK, record_captures=None)}, InputError, "toy records no captures"),
    ],
)
def test_what_cannot_be_collected_is_named_and_nothing_is_written(tmp_path, settings, error, message):
    if settings.get("weights") == "there":
        settings = settings | {"weights": Actor(SIZES).save_pretrained(tmp_path / "policy")}
    out = tmp_path / "out"
    with pytest.raises(error, match=message):
        gather(out, **settings)
    assert not out.exists()


def test_weights_for_a_planner_that_has_none_are_refused(tmp_path):
    weights = Actor(SIZES).save_pretrained(tmp_path / "policy")
    with pytest.raises(InputError, match="weights are for a policy, but straight of toy is not one"):
        gather(tmp_path, "arrivals", weights=weights)


def test_the_number_of_torchs_threads_is_put_back(tmp_path):
    before = torch.get_num_threads()
    gather(tmp_path)
    assert torch.get_num_threads() == before


def test_data_of_one_task_is_not_taken_for_anothers(tmp_path):
    gather(tmp_path, "arrivals", episodes=4)
    with pytest.raises(InputError, match="scene is toy-1 there"):
        collect(load_task("trapper"), "arrivals", tmp_path, episodes=4, num_envs=4, num_threads=1)


def test_a_recorder_that_leaves_something_out_is_named(tmp_path):
    def record(blocks, **how):
        return {name: value for name, value in record_paths(blocks, **how).items() if name not in ("start", "length")}

    with pytest.raises(InputError, match="what toy records of paths lacks start, length"):
        gather(tmp_path, task=replace(TASK, record_paths=record))


def fits(folder, what="arrivals"):
    """What training takes the data in ``folder`` for."""
    return shards.read_description(folder, what, scene="toy-1")


def test_shards_are_held_against_their_description(tmp_path):
    gather(tmp_path, episodes=10)
    assert fits(tmp_path, "paths")["data"][0]["episodes"] == 10
    with pytest.raises(InputError, match=r"paths-0-001.* lies beyond the 6 episodes asked for"):
        gather(tmp_path, episodes=6)
    text = (tmp_path / "paths-0.json").read_text()
    (tmp_path / "paths-0.json").write_text(text.replace('"episodes": 10', '"episodes": 6'))
    with pytest.raises(InputError, match=r"paths-0-001.* belongs to no description"):
        fits(tmp_path, "paths")
    (tmp_path / "paths-0.json").write_text(text.replace('"episodes": 10', '"episodes": 13'))
    with pytest.raises(InputError, match=r"paths-0-001.* is not what its description says: episodes is 4 there, 6 in"):
        fits(tmp_path, "paths")
    (tmp_path / "paths-0.json").write_text(text)
    (tmp_path / "paths-0-000.safetensors").unlink()
    with pytest.raises(InputError, match=r"paths-0-000.*not a whole safetensors file"):
        fits(tmp_path, "paths")


def test_a_killed_collection_is_not_taken_for_a_whole_one(tmp_path):
    def killed(blocks, **how):
        if blocks[0][0] > 0:
            raise KeyboardInterrupt
        return record_paths(blocks, **how)

    gather(tmp_path, episodes=10)
    with pytest.raises(KeyboardInterrupt):
        gather(tmp_path, task=replace(TASK, record_paths=killed), seed=1)
    with pytest.raises(InputError, match=r"paths-1-000.* belongs to no description.*did not finish"):
        fits(tmp_path, "paths")
    gather(tmp_path, seed=1)
    assert [one["seed"] for one in fits(tmp_path, "paths")["data"]] == [0, 1]


def test_arrivals_of_two_static_planners_train_no_network(tmp_path):
    gather(tmp_path, "arrivals")
    assert fits(tmp_path)["static"] == "straight"
    gather(tmp_path, "arrivals", static="learned", seed=1)
    with pytest.raises(InputError, match=r"arrivals-1-000.* has data of learned, others .* of straight"):
        fits(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"scene": "toy-1", "arguments": null}', '{"scene": 3, "arguments": {}}', "[" * 10**5]
)
def test_a_damaged_description_is_named(tmp_path, text):
    gather(tmp_path)
    (tmp_path / "paths-0.json").write_text(text)
    with pytest.raises(InputError, match=r"paths-0\.json"):
        fits(tmp_path, "paths")
    about = {"episodes": -3, "seed": 0, "num_envs": 4, "static": "x"}
    for name, value in (("episodes", -3), ("episodes", 1e400), ("seed", None), ("num_envs", "4"), ("static", 1)):
        changed = {"scene": "toy-1", "arguments": about | {"episodes": 10} | {name: value}}
        (tmp_path / "paths-0.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=r"paths-0\.json"):
            fits(tmp_path, "paths")


@pytest.mark.parametrize(
    "change",
    [
        {"start": torch.zeros(6, dtype=torch.int64)},
        {"length": torch.zeros(6)},
        {"positions": torch.full((3, 3), torch.nan)},
        {"positions": torch.zeros(4)},
        {"pocketed": torch.zeros(2, dtype=torch.bool)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_paths_that_do_not_lie_end_to_end_are_refused(tmp_path, change):
    gather(tmp_path, episodes=6)
    file = tmp_path / "paths-0-000.safetensors"
    with safe_open(file, "pt") as content:
        made = content.metadata()
    save_file(load_file(file) | change, file, made)
    with pytest.raises(InputError, match=re.escape(str(tmp_path))):
        load_paths(tmp_path)


def test_a_shard_under_another_name_is_refused(tmp_path):
    gather(tmp_path, episodes=12)
    first, second = sorted(tmp_path.glob("paths-*.safetensors"))
    second.write_bytes(first.read_bytes())
    says = r"paths-0-001.* is the shard paths-0-000 under another name: delete it"
    with pytest.raises(InputError, match=says):
        fits(tmp_path, "paths")
    with pytest.raises(InputError, match=says):
        gather(tmp_path, episodes=12)


def test_a_shard_whose_numbers_were_changed_is_refused(tmp_path):
    gather(tmp_path, episodes=6)
    file = tmp_path / "paths-0-000.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"paths-0-000.* is damaged: it differs from what was written"):
        load_paths(tmp_path)


def test_a_description_under_another_name_is_refused(tmp_path):
    gather(tmp_path, episodes=6)
    (tmp_path / "paths-3.json").write_bytes((tmp_path / "paths-0.json").read_bytes())
    with pytest.raises(InputError, match=r"paths-3.json' describes another series, whose description is paths-0.json"):
        fits(tmp_path, "paths")


def test_tensors_that_share_memory_are_written(tmp_path):
    def record(planner, **how):
        made = record_arrivals(planner, **how)
        return made | {"robot_state": made["goal"]}

    (shard,) = gather(tmp_path, "arrivals", replace(TASK, record_arrivals=record))
    assert torch.equal(shard["robot_state"], shard["goal"])


@pytest.mark.parametrize("name", ["x" * 300, "loop"])
def test_a_folder_that_cannot_be_read_is_named(tmp_path, name):
    if name == "loop":
        (tmp_path / name).symlink_to(tmp_path / name)
    with pytest.raises(InputError, match=name[:9]):
        fits(tmp_path / name, "paths")
