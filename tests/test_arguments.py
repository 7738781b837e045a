"""What public functions are given is compared with their type hints."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from fg_calib import Options, Robot
from fg_calib.inputs import Strategy, check_type, checked


@checked
def named(path: Path | str, options: Options | None = None, robots: Sequence[Robot] = ()):
    """Its arguments."""
    return path, options, robots


@pytest.mark.parametrize(("arguments", "message"), [
    ((3,), "path: found 3, expected a path"),
    (("",), "path: found '', expected a path"),
    (("a", "pose"), "options: found 'pose', expected an Options, such as Options"),
    (("a", None, [None]), "robots: found [None], expected a list of Robot"),
])  # fmt: skip
def test_an_argument_that_does_not_fit_is_one_line(arguments, message):
    assert message in refusal(named, *arguments)


def test_a_wrong_call_fails_in_pythons_own_words():
    assert refusal(named, error=TypeError) == "named() missing 1 required positional argument: 'path'"
    said = refusal(named, "a", option=3, error=TypeError)
    assert said.startswith("named() got an unexpected keyword argument 'option'")


def test_choices_and_switches_are_checked_and_numbers_where_they_are_used():
    check_type("x", "text", float)
    check_type("x", "star", Strategy | None)
    check_type("x", np.True_, bool)
    assert "x: found 'yes', expected True or False" in refusal(check_type, "x", "yes", bool)
