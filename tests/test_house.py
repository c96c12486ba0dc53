"""How the code stands: few modules at the root, Algorithm 1 on a page, no function long or with many arguments without a reason."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from measure_house import PACKAGE, functions

MOST_AT_ROOT = 5  # beside the package itself and Algorithm 1


def test_the_root_holds_few_modules():
    at_root = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "algorithm"}
    assert len(at_root) <= MOST_AT_ROOT, at_root


def test_algorithm_1_fits_on_a_page():
    assert len((PACKAGE / "algorithm.py").read_text().splitlines()) <= 120


@pytest.mark.parametrize(("what", "reason"), [("is_long", "# Long:"), ("takes_many", "# Arguments:")])
def test_what_is_large_says_why(what, reason):
    silent = [each.name for each in functions() if getattr(each, what) and reason not in each.reasons]
    assert not silent


@pytest.mark.parametrize(("what", "reason"), [("is_long", "# Long:"), ("takes_many", "# Arguments:")])
def test_no_reason_is_left_of_what_was_large(what, reason):
    stale = [each.name for each in functions() if reason in each.reasons and not getattr(each, what)]
    assert not stale
