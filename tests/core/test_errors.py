import pytest

from fragprune_plugins import errors
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.hosts.findings import Finding

KINDS = [k for k in vars(errors).values() if isinstance(k, type) and issubclass(k, FragpruneError)]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_error_says_where_what_was_expected_and_what_to_do(kind):
    error = kind("a place", "one thing", "another", "Do this.")
    assert str(error) == f"[{kind.code}] a place: one thing; expected another. Do this."
    assert error.as_dict() == {
        "code": kind.code,
        "where": "a place",
        "found": "one thing",
        "expected": "another",
        "remedy": "Do this.",
    }
    assert kind.__doc__


def test_codes_tell_the_kinds_apart():
    assert len({kind.code for kind in KINDS}) == len(KINDS)


def test_a_finding_prints_like_an_error_and_leaves_out_what_it_lacks():
    whole = Finding("error", "seam", "a:b", "gone", "one", "Look.")
    assert str(whole) == "[seam] a:b: gone; expected one. Look."
    assert str(Finding("info", "note", "a", "b")) == "[note] a: b"
    assert whole.as_dict()["level"] == "error"
