from torchdyn_plan import keys

CONSTANTS = {name: value for name, value in vars(keys).items() if name.isupper() and isinstance(value, str)}
SYMBOLS = {"N", "A", "H", "F", "S"}


def test_every_constant_has_one_entry_in_the_table():
    assert sorted(CONSTANTS.values()) == sorted(key.name for key in keys.KEYS)


def test_a_constant_is_its_own_name():
    assert {name.lower(): value for name, value in CONSTANTS.items()} == {v: v for v in CONSTANTS.values()}


def test_shapes_are_numbers_or_known_symbols():
    for key in keys.KEYS:
        assert all(isinstance(size, int) or size in SYMBOLS for size in key.shape), key


def test_everything_says_what_it_means_and_who_writes_it():
    assert all(key.meaning and key.writer for key in keys.KEYS)
