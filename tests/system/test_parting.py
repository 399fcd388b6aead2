"""Which tests `make test` leaves to the night."""

import parting

LINES = {
    "a.py::test_first": {(1, 1), (1, 2)},
    "a.py::test_again": {(1, 1), (1, 2)},
    "a.py::test_quick": {(1, 1)},
    "b.py::test_family[slow]": {(2, 1)},
    "b.py::test_family[quick]": {(2, 1)},
}
QUICK = dict.fromkeys(LINES, 0.1)


def test_of_two_that_reach_the_same_the_slower_goes() -> None:
    seconds = QUICK | {"a.py::test_first": 5.0, "a.py::test_again": 4.0}
    assert parting.left(seconds, LINES, most=0) == (["a.py::test_first"], 0)
    assert parting.left(seconds, LINES, most=1) == (["a.py::test_again", "a.py::test_first"], 1)


def test_a_family_leaves_its_quickest_case() -> None:
    seconds = QUICK | {"b.py::test_family[slow]": 3.0}
    assert parting.left(seconds, LINES, most=0) == (["b.py::test_family[slow]"], 0)


def test_quick_tests_stay() -> None:
    assert parting.left(QUICK, LINES, most=9) == ([], 0)
