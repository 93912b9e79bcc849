"""Duration, samples, disk space and memory of a test, estimated before it runs; an impossible test is rejected."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from daq.core.excitation import procedure_of
from daq.core.recording.committed_file import RESERVE
from daq.core.recording.layout import block_length, flush_length
from rig.core.base.errors import SceneError
from rig.core.numerics.memory import require_memory
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene

# A test with more samples per channel is assumed to be a mistake.
MAX_SAMPLES = 1e12
# Approximate bytes per sample in a recording that contains display data, by storage type.
BYTES_PER_SAMPLE = {"counts": 4.5, "float32": 6.0, "float64": 10.7}
# Lower bound of compressed over approximate size: a disk that is smaller even than this is rejected.
MIN_COMPRESSION_RATIO = 0.005
# Bytes per sample of a true (simulated) quantity in a recording, measured on random motion with dampers.
TRUTH_BYTES_PER_SAMPLE = 6.0
# Measured memory of a recording process without channels (libraries and compiled functions) [bytes].
PROGRAM_BYTES = 0.33e9
# Measured memory of the signal path of a channel without decimation filter [bytes].
CHANNEL_BYTES = 0.15e6
# Measured memory of the signal path of a channel with decimation filter [bytes].
FILTERED_CHANNEL_BYTES = 0.4e6
# Measured memory of the matrices of a structure [bytes]; multiply by the square of the number of bodies.
STRUCTURE_BYTES = 180.0
# Number of copies of a block in memory during recording: of each channel, of the motion, and of recorded true motion.
CHANNEL_COPIES = 5.0
MOTION_COPIES = 2.0
TRUTH_COPIES = 7.0
# Number of copies of a stored drive in memory.
DRIVE_COPIES = 12.0
_MEMORY_PURPOSE = "the test, with the matrices of its structure and half a second of all its channels,"


@dataclass(frozen=True)
class Estimate:
    """Lower bounds of the resources of a test, without the waits for steady states."""

    seconds: float  # duration of the test [s]
    samples: float  # number of samples per channel
    disk: float  # size of the recording [bytes]
    memory: float  # memory during the test [bytes]


def estimate(scene: Scene) -> Estimate:
    """Estimate lower bounds of duration, samples, disk space and memory of a scene's test.

    >>> import rig
    >>> scene = rig.load("fig10b-no-damper")
    >>> needed = estimate(scene.replace(test=scene.test.replace(repeats=200, interval="9 s")))
    >>> needed.seconds, f"{needed.samples:.3g} samples a channel, {needed.disk / 1e6:.0f} MB"
    (1800.0, '9.22e+06 samples a channel, 166 MB')
    """
    rate = scene.converter.sample_rate
    # A scene without `channels` is measured by an ideal channel on every body and on the table.
    channels = scene.structure.bodies + 1 if scene.channels is None else len(scene.channels)
    test = scene.test
    seconds, stored = (0.0, 0.0) if test is None else (test.shortest, procedure_of(test).stored(test))
    samples = seconds * rate
    buffer_length = flush_length(rate) + 2 * block_length(rate)
    filtered = complete_from_preset(scene.converter).filter is not None
    channel_bytes = FILTERED_CHANNEL_BYTES if filtered else CHANNEL_BYTES
    motion_copies = 3 * scene.structure.bodies * (TRUTH_COPIES if scene.recording.truth else MOTION_COPIES)
    memory = (
        PROGRAM_BYTES + channels * channel_bytes + 8.0 * buffer_length * (CHANNEL_COPIES * channels + motion_copies)
    )
    memory += 8.0 * DRIVE_COPIES * stored * rate + STRUCTURE_BYTES * scene.structure.bodies**2
    points = scene.structure.bodies + len(scene.tables)
    n_true_quantities = 3 * points + len(scene.dampers) if scene.recording.truth else 0
    storage_type = scene.recording.samples or ("float64" if scene.converter.bits is None else "counts")
    disk = samples * (BYTES_PER_SAMPLE[storage_type] * channels + TRUTH_BYTES_PER_SAMPLE * n_true_quantities)
    return Estimate(seconds, samples, disk, memory)


def check_resources(resources: Estimate, path: Path) -> None:
    """Raise `SceneError` for a test with too many samples, or more than the free disk space or memory."""
    if not resources.samples <= MAX_SAMPLES:
        raise SceneError(
            f"test: in {duration_text(resources.seconds)}, each channel has {resources.samples:.3g} samples; the "
            f"maximum is {MAX_SAMPLES:.0e}. Choose a shorter test or a lower rate."
        )
    require_memory(resources.memory, _MEMORY_PURPOSE)
    folder = next(folder for folder in path.absolute().parents if folder.is_dir())
    free = shutil.disk_usage(folder).free
    if resources.disk * MIN_COMPRESSION_RATIO + RESERVE > free:
        raise SceneError(
            f"{path}: the test requires about {_bytes_text(resources.disk)}, but only {_bytes_text(free)} are free. "
            "Choose another disk (-o FILE.mcap), a shorter test, or a lower rate."
        )


def duration_text(seconds: float) -> str:
    """Write a time in a readable unit.

    >>> duration_text(1.234), duration_text(18.25), duration_text(390.0), duration_text(7200.0), duration_text(1e9)
    ('1.23 s', '18 s', '6.5 min', '2.0 h', '31.7 years')
    """
    for unit, unit_s in (("years", 3.156e7), ("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * unit_s:
            return f"{seconds / unit_s:.1f} {unit}"
    return f"{seconds:.3g} s" if seconds < 10.0 else f"{seconds:.0f} s"


def _bytes_text(n_bytes: float) -> str:
    """Write a number of bytes in a readable unit."""
    for unit, unit_bytes in (("TB", 1e12), ("GB", 1e9)):
        if n_bytes >= unit_bytes:
            return f"{n_bytes / unit_bytes:.3g} {unit}"
    return f"{n_bytes / 1e6:.1f} MB"
