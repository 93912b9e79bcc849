"""Resonance peaks between the lines of a curve, compared with closed form."""

import numpy as np

from rig.core.results.resonances import find_resonances
from rig.core.results.response import Response
from tests.rig.results.test_interpolation import MODES, exact, measured


def test_every_resonance_is_refined() -> None:
    resonances = find_resonances(measured(0.4, 1e-4, start=20.29))
    assert len(resonances) == len(MODES)
    for resonance, (natural, zeta, _) in zip(resonances, MODES, strict=True):
        grid = natural * (1.0 + zeta * np.linspace(-1.0, 1.0, 2001))
        assert abs(resonance.frequency - natural) < 0.1 * zeta * natural
        assert abs(resonance.value - abs(exact(grid)).max()) < resonance.expanded < 0.02 * resonance.value


def test_points_in_half_power_width_are_counted() -> None:
    coarse, fine = (find_resonances(measured(spacing))[0] for spacing in (0.2, 0.04))
    # The half-power width is 2 * 0.0045 * 30.49 Hz.
    assert coarse.lines < 3 and coarse.needed_spacing < 0.0915
    assert fine.lines == 3 and fine.needed_spacing == np.inf


def test_noise_has_no_resonances() -> None:
    random, lines = np.random.default_rng(3), np.arange(20.0, 60.0, 0.1)
    noise = random.normal(size=lines.size) + 1j * random.normal(size=lines.size)
    curve = Response.curve(
        lines, noise, "board", error=np.ones(lines.size), degrees_of_freedom=np.full(lines.size, 30.0)
    )
    assert len(find_resonances(curve)) <= 1
