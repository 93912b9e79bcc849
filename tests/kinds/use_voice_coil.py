"""Use a voice coil in all ways in which a kind of shaker is used, and print the results as JSON."""

import json
import sys
import warnings
from typing import Any

import numpy as np

import analysis
import daq
import rig
from analysis.commands.report_page.drawing import rig_drawing
from daq.core.drawing.rig_view import Extremes, RigView
from daq.core.signal_chain.converter import describe_output
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import riding_response

SCENE: dict[str, Any] = {
    "name": "voice coil",
    "structure": {"masses": [0.74, 0.71, 0.64], "springs": [24300, 21800, 19800], "damping": {"modal": 0.02}},
    "dampers": [{"body": 2, "mass_ratio": 0.05, "clearance": "1 mm"}],
    "shaker": {"kind": "voice_coil", "body": 1, "spring": "6.6 kN/m", "limit": "50 V"},
    "converter": {"rate": 2000},
    "test": {"kind": "stepped_sine", "frequencies": ["20 Hz", "40 Hz"], "drive": "0.5 V"},
}


def main(recording: str) -> None:
    """Print the results; `recording`: file to write."""
    warnings.simplefilter("ignore")
    scene = rig.load(SCENE)
    daq.record(scene, recording)
    controlled = recording.replace(".mcap", "-controlled.mcap")
    daq.record(scene.replace(test={"kind": "stepped_sine", "frequencies": [20.0], "force": 0.3}), controlled)
    run = rig.simulate(scene, 1.0, rate=2000.0)
    with daq.open(recording) as rec:
        force, table = analysis.frfs(rec), analysis.frfs(rec, reference="table")
    with daq.open(controlled) as rec:
        [reached] = (marker.fields["force"] for marker in rec.markers if marker.kind == "measure")
    linear = assemble(scene)
    states = riding_response(linear, "shaker", 2.0 * np.pi * np.array([20.0, 40.0]))
    view = RigView(scene, Extremes(), gaps_known=True)
    results = {
        "message": _message({"test.drive": "1 N"}),
        "channel_message": _message({"channels": [{"name": "force", "at": "shaker"}]}),
        "explanation": str(rig.explain(scene)),
        "energy": [run.energy.residual, run.energy.work],
        "foresight": str(daq.foresee(scene)),
        "output": describe_output(scene, 1),
        "measured": [abs(each["body3"].value).tolist() for each in (force, table)],
        "exact": abs(rig.frequency_response(scene, [20.0, 40.0]).compliance[2]).tolist(),
        "exact_ratio": abs(states[2] / states[3]).tolist(),
        "reached": reached,
        "drawing": rig_drawing(scene),
        "entities": [entity for entity, _ in view.static_parts()],
    }
    print(json.dumps(results))


def _message(changes: dict[str, Any]) -> str:
    try:
        rig.load(SCENE, changes)
    except rig.SceneError as error:
        return str(error)
    return ""


if __name__ == "__main__":
    main(sys.argv[1])
