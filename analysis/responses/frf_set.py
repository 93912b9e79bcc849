"""All frequency responses of one sweep or test: what modes are identified from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, overload

from numpy.typing import NDArray

from analysis.responses.frf import Frf
from rig.results import Result, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class FrfSet(Result, Sequence[Frf]):
    """Frequency responses measured together, by number or by the name of their channel.

    Parameters
    ----------
    curves : iterable of Frf
        At the same frequencies.
    """

    def __init__(self, curves: Iterable[Frf]) -> None:
        self._curves = tuple(curves)

    def __len__(self) -> int:
        return len(self._curves)

    @overload
    def __getitem__(self, which: int | str) -> Frf: ...
    @overload
    def __getitem__(self, which: slice) -> FrfSet: ...
    def __getitem__(self, which: int | str | slice) -> Frf | FrfSet:
        """Give one by its number or channel, or some of them."""
        if isinstance(which, str):
            return {curve.response: curve for curve in self._curves}[which]
        return FrfSet(self._curves[which]) if isinstance(which, slice) else self._curves[which]

    def summary(self) -> str:
        """Say which they are."""
        first = self._curves[0]
        return (
            f"{first.label}: {first.name} of {', '.join(curve.response for curve in self._curves)}, "
            f"{first.frequency.size} points, {first.frequency.min():.4g} to {first.frequency.max():.4g} Hz"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Frequency; value and 95 % bound of each."""
        found: dict[str, NDArray[Any]] = {"frequency_Hz": self._curves[0].frequency}
        for curve in self._curves:
            found[f"{curve.response}_{curve.unit}"] = curve.value
            found[f"{curve.response}_bound_{curve.unit}"] = curve.bound()
        return found

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw all into one."""
        for curve in self._curves:
            curve.draw(ax, **styled(style, label=curve.response))
