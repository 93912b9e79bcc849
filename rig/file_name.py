"""Names of the files that a study of a scene writes."""

from __future__ import annotations


def stem(study: str, scene: str) -> str:
    """Name a study's files after it and its scene.

    Examples
    --------
    >>> stem("cost", "Fig 9, a damper in body 2")
    'cost-fig-9-a-damper-in-body-2'
    """
    words = "".join(letter if letter.isalnum() else " " for letter in scene.lower()).split()
    return "-".join([study, *words])
