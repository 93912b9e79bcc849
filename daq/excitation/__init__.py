"""Excitations of tests, one module per kind of test: they use channels, never the state of the simulator.

A module named after the kind of test contains `excite`. The other modules support them: `station` is the interface to
the bench, `amplitude_control` and `sweep_control` control the force, `settling` detects the steady state. Start with
`sine`.
"""

from __future__ import annotations

from importlib import import_module

from daq.excitation.station import Excitation, Station
from rig.errors import SceneError

__all__ = ["Excitation", "Station", "excitation"]


def excitation(station: Station) -> Excitation:
    """Return the excitation of the scene's test."""
    test = station.scene.test
    if test is None:
        raise SceneError(
            f"scene {station.scene.name!r} names no test. Add a test, such as "
            "test: {kind: impulse, body: 1, peak: 50 N, width: 4 ms}."
        )
    return import_module(f"daq.excitation.{test.kind}").excite(station, test)
