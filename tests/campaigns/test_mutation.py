"""The table of ``campaigns.mutation``; mutmut itself takes an hour."""

import pytest
from campaigns import mutation


@pytest.mark.parametrize(("wanted", "code"), [(0.6, 0), (0.8, 1)])
def test_a_module_of_which_too_little_was_noticed_fails(wanted, code, capsys):
    outcomes = dict.fromkeys((f"fragprune_plugins.files.ply.x{n}" for n in range(3)), "killed")
    outcomes |= {"fragprune_plugins.files.ply.x3": "survived", "fragprune_plugins.types.x4": None}
    assert mutation.table(outcomes, wanted) == code
    printed = capsys.readouterr().out
    assert "| files.ply | 4 | 4 | 3 | 0 | 1 | 0 | 0 | 75% (30% to 95%) |" in printed
    assert "| all | 5 | 4 |" in printed
