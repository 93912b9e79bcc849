"""Use two tones at once in all ways in which a kind of test is used, and print the results as JSON."""

import json
import sys
import warnings
from pathlib import Path

import analysis
import daq
import rig
from daq.extras.bench_page.live_bench import offered_forms
from rig.core.scene.json_schema import schema_text
from rig.core.scene.reference import help_on

SCENE = {
    "name": "two tones",
    "structure": {"masses": [0.74, 0.71, 0.64], "springs": [24300, 21800, 19800], "damping": {"modal": 0.02}},
    "shaker": {"kind": "table", "body": 1, "spring": "6.6 kN/m"},
    "converter": {"rate": 2000},
    "test": {"kind": "two_tones", "frequencies": ["20 Hz", "33.3 Hz"], "drive": "0.1 mm", "duration": "8 s"},
}


def main(recording: str) -> None:
    """Print the results; `recording`: file to write."""
    warnings.simplefilter("ignore")
    # The generated schema, which `rig help` reads.
    schema = Path(rig.__file__).parent / "core" / "scene" / "data" / "scene.schema.json"
    schema.write_text(schema_text(), encoding="utf-8")
    scene = rig.load(SCENE)
    exact = rig.frequency_response(scene.replace(test={"kind": "sine", "frequency": 20.0, "drive": 1e-4}), [20.0, 33.3])
    daq.record(scene, recording)
    messages = []
    for frequencies in (["20 Hz", "2 kHz"], ["20 Hz", "20.3 Hz"]):
        try:
            rig.load(SCENE, {"test.frequencies": frequencies})
        except rig.SceneError as error:
            messages.append(str(error))
    with daq.open(recording) as rec:
        response = analysis.frfs(rec)
    results = {
        "messages": messages,
        "explanation": str(rig.explain(scene)),
        "steady": rig.response(scene).frequency.tolist(),
        "simulated": float(abs(rig.simulate(scene, 1.0, rate=2000.0).displacement).max()),
        "foresight": str(daq.foresee(scene)),
        "info": str(daq.info(recording)),
        "forms": list(offered_forms(scene)),
        "help": help_on("test.two_tones") + help_on("dampers"),
        "measured": abs(response["body3"].value).tolist(),
        "uncertainty": (response["body3"].expanded() / abs(response["body3"].value)).tolist(),
        "exact": abs(exact.compliance[2]).tolist(),
    }
    print(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1])
