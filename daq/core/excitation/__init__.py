"""Excitations: drive signals of tests, computed from the scene and from the channels, as on a real bench.

Each kind of test has a module of its name with a `Procedure`. `station` is the interface to the bench. The
controllers are in `tones` and `profiles`. Start with `sine`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from daq.core.excitation.controlled import controlled
from daq.core.excitation.station import Excitation, Station
from rig.core.base.errors import SceneError
from rig.core.scene.excitation import KindOfTest, Test
from rig.core.scene.scene import Scene

if TYPE_CHECKING:
    from daq.core.excitation.procedure import Procedure

__all__ = ["Excitation", "Station", "excitation", "procedure_of", "test_of"]


def test_of(scene: Scene) -> Test:
    """Return the test of a scene; raise `SceneError` if it has none."""
    if scene.test is None:
        raise SceneError(
            f"scene {scene.name!r} has no test. Add a test, such as "
            "test: {kind: impulse, body: 1, peak: 50 N, width: 4 ms}."
        )
    return scene.test


def excitation(station: Station) -> Excitation:
    """Return the excitation of the scene's test; raise `SceneError` if channels of a controlled force are missing."""
    test = test_of(station.scene)
    controlled(station)
    return procedure_of(test).excite(station, test)


def procedure_of(test: KindOfTest | type[KindOfTest]) -> Procedure[Any]:
    """Return the procedure of a kind of test; raise `SceneError` if tests of this kind can only be simulated."""
    module = f"daq.core.excitation.{test.kind_name()}"
    try:
        procedure: Procedure[Any] = import_module(module).PROCEDURE
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise SceneError(
            f"test: kind {test.kind_name()} can be simulated but not recorded. Use rig.simulate."
        ) from None
    return procedure
