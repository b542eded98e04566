from types import ModuleType

import pytest

from torchdyn_plan import keys
from torchdyn_plan.envs.fetch_reach import keys as fetch_reach_keys
from torchdyn_plan.envs.trapper import keys as trapper_keys

SYMBOLS = {"D", "N", "A", "H", "F", "S", "M", "K"}
TABLES = pytest.mark.parametrize("module", [keys, trapper_keys, fetch_reach_keys])


def constants(module: ModuleType) -> dict[str, str]:
    return {name: value for name, value in vars(module).items() if name.isupper() and isinstance(value, str)}


@TABLES
def test_every_constant_has_one_entry_in_the_table(module):
    assert sorted(constants(module).values()) == sorted(key.name for key in module.KEYS)


@TABLES
def test_a_constant_is_its_own_name(module):
    assert {name.lower(): value for name, value in constants(module).items()} == {
        value: value for value in constants(module).values()
    }


@TABLES
def test_shapes_are_numbers_or_known_symbols(module):
    for key in module.KEYS:
        assert all(isinstance(size, int) or size in SYMBOLS for size in key.shape), key


@TABLES
def test_everything_says_what_it_means_and_who_writes_it(module):
    assert all(key.meaning and key.writer for key in module.KEYS)


@pytest.mark.parametrize("module", [trapper_keys, fetch_reach_keys])
def test_a_task_adds_keys_and_changes_none(module):
    assert not {key.name for key in module.KEYS} & {key.name for key in keys.KEYS}
