"""How malformed input must be refused."""

import pytest

from simtest.errors import InputError


def refused(call, *fragments, longest=700):
    """Check that a call raises an `InputError` of one readable line that holds the fragments."""
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    assert text.isprintable()
    assert len(text) < longest
    for fragment in fragments:
        assert fragment in text
