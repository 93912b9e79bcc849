"""Escape text from files for terminals, pages and figures, so that it is displayed and not executed.

Names, notes and reasons in a scene or recording are untrusted text.
"""

from __future__ import annotations

import html as _html
import re

# Control characters except line feed and tab; bidirectional, invisible and line-ending characters; surrogates, which
# represent bytes of a file name that is not valid UTF-8.
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff]"
)
_MARKS = re.compile(r"([\\`*_{}\[\]()<>#+\-!|~&$])")


def shown(text: object) -> str:
    r"""Escape control characters for a terminal; line feeds and tabs are retained.

    >>> shown("body\x1b[31m 1")
    'body\\x1b[31m 1'
    """
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], str(text))


def is_line(text: str) -> bool:
    r"""Whether text is a single line without control characters.

    >>> is_line("Fig. 8, two dampers"), is_line("a\nb"), is_line("\x1b[31m")
    (True, False, False)
    """
    return shown(text) == text and not set(text) & {"\n", "\t"}


def html(text: object) -> str:
    """Escape text for HTML, also for quoted attributes.

    >>> html("<b> & 'x'")
    '&lt;b&gt; &amp; &#x27;x&#x27;'
    """
    return _html.escape(shown(text))


def markdown(text: object) -> str:
    r"""Escape text for a line of Markdown.

    >>> print(markdown("<b> *body*\n# 1"))
    \<b\> \*body\* \# 1
    """
    return _MARKS.sub(r"\\\1", " ".join(shown(text).split()))


def drawn(text: object) -> str:
    r"""Escape text for a figure, where dollar signs delimit mathematics.

    >>> print(drawn("from $1 to $2"))
    from \$1 to \$2
    """
    return shown(text).replace("$", r"\$")


def fenced(text: object, language: str = "") -> str:
    r"""Enclose lines in a Markdown code fence that is longer than any fence in the text.

    >>> print(fenced("a: 1\n```", "yaml"))
    ````yaml
    a: 1
    ```
    ````
    """
    lines = shown(text)
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", lines)), default=0))
    return f"{fence}{language}\n{lines}\n{fence}"
