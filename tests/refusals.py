"""What a call says when it refuses its input."""

import pytest


def said_by(call, *arguments, **named):
    """The one line of the ValueError."""
    with pytest.raises(ValueError) as caught:
        call(*arguments, **named)
    said = str(caught.value)
    assert "\n" not in said
    return said
