"""Text of a file on its way to a person: what a terminal, a page or a figure would obey is shown instead.

Names, notes and reasons in a scene or a recording are anybody's text.
"""

from __future__ import annotations

import html as _html
import re

# Control characters but line end and tab; what turns the direction of writing, is invisible or ends lines; halves
# of characters, as which bytes of a file's name come that are no UTF-8.
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff]"
)
_MARKS = re.compile(r"([\\`*_{}\[\]()<>#+\-!|~&$])")


def shown(text: object) -> str:
    r"""Show what a terminal would obey; lines and tabs stay.

    >>> shown("body\x1b[31m 1")
    'body\\x1b[31m 1'
    """
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], str(text))


def is_line(text: str) -> bool:
    r"""Whether text is one line in which there is nothing to obey.

    >>> is_line("Fig. 8, two dampers"), is_line("a\nb"), is_line("\x1b[31m")
    (True, False, False)
    """
    return shown(text) == text and not set(text) & {"\n", "\t"}


def html(text: object) -> str:
    """Show text in HTML, also within the quotes of an attribute.

    >>> html("<b> & 'x'")
    '&lt;b&gt; &amp; &#x27;x&#x27;'
    """
    return _html.escape(shown(text))


def markdown(text: object) -> str:
    r"""Show text within a line of Markdown.

    >>> print(markdown("<b> *body*\n# 1"))
    \<b\> \*body\* \# 1
    """
    return _MARKS.sub(r"\\\1", " ".join(shown(text).split()))


def drawn(text: object) -> str:
    r"""Show text in a figure, which would take what stands between dollars for mathematics.

    >>> print(drawn("from $1 to $2"))
    from \$1 to \$2
    """
    return shown(text).replace("$", r"\$")


def fenced(text: object, language: str = "") -> str:
    r"""Show lines as they stand in Markdown, between fences longer than any in them.

    >>> print(fenced("a: 1\n```", "yaml"))
    ````yaml
    a: 1
    ```
    ````
    """
    lines = shown(text)
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", lines)), default=0))
    return f"{fence}{language}\n{lines}\n{fence}"
