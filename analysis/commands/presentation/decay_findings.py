"""Output of `analysis decay`: free decays as text, figures and tables."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from analysis.commands.presentation.inputs import check_recording, duplicate_warnings
from analysis.commands.presentation.outputs import (
    CommandOutput,
    check_outputs,
    output_stem,
    with_ending,
    with_recording_name,
)
from analysis.core.decays.free_decay import INITIAL_DECAY_DB, NO_INTERVAL, Decay, decay
from analysis.core.recordings.descriptions import full_test_text
from analysis.core.recordings.names import baseline_label, relabel, scene_labels
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from rig.core.base.palette import location_styles, recording_styles


@with_recordings
def present_decay(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    output: Path | None = None,
    channel: str | None = None,
    impact: int = 1,
) -> CommandOutput:
    """Draw and tabulate free decays; the curves of several recordings are overlaid.

    `paths`: recordings of impact tests or free decays; `output`: folder for figures and tables, by default the folder
    of the first recording; `channel`: motion channel, by default the channel of the last body; `impact`: number of the
    impact, from 1.
    """
    from analysis.commands.figures.decay_figure import decay_figure
    from analysis.commands.presentation.tables import damping_table, envelope_table
    from rig.core.base.figure_style import save_figure

    decays: list[Decay] = []
    moving: dict[str, bool] = {}
    excitations, places = [], []
    warnings = duplicate_warnings(paths)
    stem = output_stem(paths, output, "decay")
    envelopes, dampings = (stem.with_name(f"{stem.name}-{table}.csv") for table in ("envelope", "damping"))
    check_outputs(paths, with_ending(stem, "png"), with_ending(stem, "svg"), envelopes, dampings)
    for path, label in zip(paths, scene_labels(recordings, paths), strict=True):
        rec = recordings.of(path)
        check_recording(rec, path, "decay")
        decays.append(relabel(decay(rec, channel, impact), rec.scene.name, label))
        has_impacts = rec.test.drives
        moving[label] = not rec.scene.is_linear
        excitations.append(full_test_text(rec))
        places.append(rec.channels[decays[-1].channel].at)
        warnings += with_recording_name(path, decays[-1].warnings)
    first = decays[0]
    title = f"Free decay of {first.channel}{f' after impact {impact}' if has_impacts else ''}"
    if excitations[0] and len(set(excitations)) == 1:
        title += f" ({excitations[0]})"
    baseline = baseline_label(moving)
    styles = recording_styles([name == baseline for name in moving]) if baseline else location_styles(places)
    files = save_figure(decay_figure(decays, title, styles), stem)
    files += [envelope_table(envelopes, decays), damping_table(dampings, decays)]
    return CommandOutput(
        tuple(files), tuple(line for result in decays for line in describe_decay(result)), tuple(warnings)
    )


def describe_decay(decay: Decay) -> list[str]:
    """Describe a decay: the time from which it stays below 1 g, and damping ratios with 95 % intervals."""
    time_below_gravity = decay.quiet_from
    below_text = (
        "does not stay below 1 g within the recording"
        if np.isnan(time_below_gravity)
        else f"stays below 1 g after about {time_below_gravity:.2g} s"
    )
    time_of_6_db = decay.halving
    energy_text = (
        f"does not fall by {-INITIAL_DECAY_DB[1]:.0f} dB within the recording"
        if np.isnan(time_of_6_db)
        else f"falls by 6 dB in about {time_of_6_db:.2g} s (slope from -1 to -11 dB)"
    )
    return [
        f"{decay.label}, {decay.channel}: acceleration {below_text}; backward-integrated energy {energy_text}; "
        f"{NO_INTERVAL}",
        *decay.table().lines("  "),
    ]
