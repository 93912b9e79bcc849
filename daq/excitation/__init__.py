"""The excitations a test can run, one module for each kind of test: they see channels, never the simulator's state.

A module named after the test's kind holds `excite`; the others help them: `station` is what a test has before it,
`amplitude_control` and `sweep_control` hold the force, `settling` detects steady motion. Start with `sine`.
"""

from __future__ import annotations

from importlib import import_module

from daq.excitation.station import Excitation, Station
from rig.errors import SceneError

__all__ = ["Excitation", "Station", "excitation"]


def excitation(station: Station) -> Excitation:
    """Make the excitation of the scene's test.

    Raises
    ------
    SceneError
        If the scene names no test, or one that needs what is not on the bench.
    """
    test = station.scene.test
    if test is None:
        raise SceneError(
            f"scene {station.scene.name!r} names no test: add one, such as "
            "test: {kind: impulse, body: 1, peak: 50 N, width: 4 ms}"
        )
    return import_module(f"daq.excitation.{test.kind}").excite(station, test)
