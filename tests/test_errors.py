"""What messages quote."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hybridmap.errors import counted, quoted


@given(st.text() | st.binary())
def test_a_message_quotes_little_and_only_what_can_be_printed(found):
    said = quoted(found)
    assert said.isprintable()
    assert "\ufffd" not in said
    assert len(said) <= 40 + 2


def test_a_short_text_is_quoted_as_it_is():
    assert quoted(" 1 x\n") == "'1 x'"
    assert quoted("0123456789" * 5) == f"'{'0123456789' * 3}0123456...'"


def test_one_thing_is_no_plural():
    assert [counted(count, "loop edge") for count in (0, 1, 2.0)] == ["0 loop edges", "1 loop edge", "2 loop edges"]
