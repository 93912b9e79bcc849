"""Types of the functions by which long computations report their progress."""

from collections.abc import Callable

#: Called with the number of completed steps and the total number.
CountProgress = Callable[[int, int], None]
#: Called with the completed fraction and a text.
FractionProgress = Callable[[float, str], None]
