"""What a call that is refused says."""

import pytest

from fg_calib import InputError


def refusal(call, /, *arguments, error=InputError, **options) -> str:
    """The message of the error that a call ends with."""
    with pytest.raises(error) as caught:
        call(*arguments, **options)
    return str(caught.value)
