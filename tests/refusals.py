"""What a call that is refused says, in one line."""

import pytest

from fg_calib import InputError


def refusal(call, /, *arguments, error=InputError, **options) -> str:
    """The message of the error that a call ends with: one printable line."""
    with pytest.raises(error) as caught:
        call(*arguments, **options)
    said = str(caught.value)
    assert said.isprintable()
    return said
