"""Two tones at once: the procedure of a kind of test that exists only in the test suite."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from daq.core.excitation.procedure import Form, Procedure

if TYPE_CHECKING:
    from rig.core.scene.excitation import TwoTones


class TwoTonesProcedure(Procedure["TwoTones"]):
    """Output both tones; the second half is measured, once for each tone."""

    form = Form("two tones", ())

    def measured(self, test: TwoTones, rate: float) -> Iterable[tuple[float, float, dict[str, Any]]]:
        """Return the second half of the test for each tone."""
        return [(test.duration / 2.0, test.duration, {"frequency": frequency}) for frequency in test.frequencies]


PROCEDURE = TwoTonesProcedure()
