"""Escaping of text from files for terminals, pages and figures: the text is displayed, not executed.

Names, notes and reasons in a scene or recording are untrusted text.
"""

import re

# Control characters except line feed and tab; bidirectional, invisible and line-ending characters; surrogates, which
# represent bytes of a file name that is not valid UTF-8.
_CONTROL_CHARACTERS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff]"
)
# Text that a spreadsheet computes as a formula, even after apostrophes and after blanks that it drops.
_FORMULA = re.compile(r"['\s]*[=+\-@].", re.DOTALL)
_MARKDOWN_SYNTAX = re.compile(r"([\\`*_{}\[\]()<>#+\-!|~&$])")


def escape_terminal(text: object) -> str:
    r"""Escape control characters for a terminal; line feeds and tabs are retained.

    >>> escape_terminal("body\x1b[31m 1")
    'body\\x1b[31m 1'
    """
    return _CONTROL_CHARACTERS.sub(lambda match: ascii(match[0])[1:-1], str(text))


def is_single_line(text: str) -> bool:
    r"""Return whether text is a single line without control characters.

    >>> is_single_line("Fig. 8, two dampers"), is_single_line("a\nb"), is_single_line("\x1b[31m")
    (True, False, False)
    """
    return escape_terminal(text) == text and not set(text) & {"\n", "\t"}


def escape_html(text: object) -> str:
    """Escape text for HTML, including quoted attributes.

    >>> escape_html("<b> & 'x'")
    '&lt;b&gt; &amp; &#x27;x&#x27;'
    """
    from html import escape

    return escape(escape_terminal(text))


def escape_cell(text: str) -> str:
    """Escape text for a cell of a CSV table: a spreadsheet must not compute it as a formula.

    >>> escape_cell("=1+1"), escape_cell("-3.2"), escape_cell("body 1")
    ("'=1+1", '-3.2', 'body 1')
    """
    if _FORMULA.match(text) is None:
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def unescape_cell(cell: str) -> str:
    """Return the text of a cell that `escape_cell` wrote.

    >>> unescape_cell(escape_cell("=1+1")), unescape_cell("'body 1'")
    ('=1+1', "'body 1'")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def escape_markdown(text: object) -> str:
    r"""Escape text for a line of Markdown.

    >>> print(escape_markdown("<b> *body*\n# 1"))
    \<b\> \*body\* \# 1
    """
    return _MARKDOWN_SYNTAX.sub(r"\\\1", " ".join(escape_terminal(text).split()))


def escape_figure(text: object) -> str:
    r"""Escape text for a figure, where dollar signs delimit mathematics.

    >>> print(escape_figure("from $1 to $2"))
    from \$1 to \$2
    """
    return escape_terminal(text).replace("$", r"\$")


def code_fence(text: object, language: str = "") -> str:
    r"""Enclose lines in a Markdown code fence that is longer than any fence in the text.

    >>> print(code_fence("a: 1\n```", "yaml"))
    ````yaml
    a: 1
    ```
    ````
    """
    lines = escape_terminal(text)
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", lines)), default=0))
    return f"{fence}{language}\n{lines}\n{fence}"
