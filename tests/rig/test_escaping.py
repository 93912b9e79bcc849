"""Text from a file is displayed completely in terminals, browsers and Markdown, and never interpreted."""

from html.parser import HTMLParser
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.base.escaping import code_fence, escape_cell, escape_html, escape_markdown, escape_terminal, unescape_cell


@given(st.text())
def test_escaped_text_keeps_the_cursor_in_its_lines(text: str) -> None:
    assert all(
        character.isprintable() or character in "\n\t" or ord(character) > 0x7F for character in escape_terminal(text)
    )
    assert not any(character in escape_terminal(text) for character in "\x1b\x9b\x07\r\u202e")
    assert not text.isprintable() or escape_terminal(text) == text


class ParsedPage(HTMLParser):
    """Tags and text of a page as a browser interprets it."""

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
    parsed = ParsedPage(f"<p>{escape_html(text)}</p>")
    assert parsed.tags == ["p"] and parsed.text == escape_terminal(text)


@given(st.text())
def test_escaped_markdown_has_no_active_markup(text: str) -> None:
    escaped = escape_markdown(text)
    assert "\n" not in escaped
    assert not any(escaped[k] in "*_<>[]`#|" and escaped[k - 1 : k] != "\\" for k in range(len(escaped)))
    opening, *content, closing = code_fence(text).split("\n")
    assert opening == closing and not any(opening in line for line in content)


@pytest.mark.parametrize("text", ["=1+1", "+cmd|'x'", "-2+3", "@SUM(1)", " =1+1", "\t=1", "=\n1+1", "\r\n@A", "'=1"])
def test_cells_are_no_formulas(text: str) -> None:
    cell = escape_cell(text)
    assert cell == f"'{text}" and unescape_cell(cell) == text


@pytest.mark.parametrize("text", ["-3.2", "+1e-5", "-inf", "body 1 = x", "", "-", " 1"])
def test_numbers_and_plain_text_stay_unescaped(text: str) -> None:
    assert escape_cell(text) == text == unescape_cell(text)
