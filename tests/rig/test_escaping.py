"""Text of a file is displayed completely and never interpreted."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rig.escaping import code_fence, escape_html, escape_markdown, escape_terminal


@given(st.text())
def test_escaped_text_keeps_the_cursor_in_its_lines(text: str) -> None:
    assert all(letter.isprintable() or letter in "\n\t" or ord(letter) > 0x7F for letter in escape_terminal(text))
    assert not any(letter in escape_terminal(text) for letter in "\x1b\x9b\x07\r\u202e")
    assert not text.isprintable() or escape_terminal(text) == text


class Seen(HTMLParser):
    """Page content as a browser interprets it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: Any) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


@given(st.text())
def test_escaped_text_is_shown_by_a_browser(text: str) -> None:
    parsed = Seen(f"<p>{escape_html(text)}</p>")
    assert parsed.tags == ["p"] and parsed.text == escape_terminal(text)


@given(st.text())
def test_escaped_markdown_has_no_bare_mark(text: str) -> None:
    line = escape_markdown(text)
    assert "\n" not in line
    assert not any(line[at] in "*_<>[]`#|" and line[at - 1 : at] != "\\" for at in range(len(line)))
    fence, *inside, last = code_fence(text).split("\n")
    assert fence == last and not any(fence in each for each in inside)
