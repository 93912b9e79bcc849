"""The tracks of a sound file (WAV, RF64, W64, FLAC, AIFF, CAF), read with soundfile; samples are read when needed."""

from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path

from daq.extras.importing.signal import Signal
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, RunError

# Bits of the integer formats; the largest integer is the full scale of the converter.
_INTEGER_BITS = {"PCM_S8": 8, "PCM_U8": 8, "PCM_16": 16, "PCM_24": 24, "PCM_32": 32}
_EXACT_FORMATS = {*_INTEGER_BITS, "FLOAT", "DOUBLE"}
# Text in the reader's log about a header that states more samples than the file contains.
_TRUNCATED = "should be"


def sound_signals(path: Path, stack: ExitStack) -> list[Signal]:
    """List the tracks of a sound file as signals in fractions of full scale; `stack` closes the file.

    Raises `RecordingError` if the file is damaged or its samples are compressed with loss.
    """
    try:
        import soundfile
    except ImportError:
        raise RunError("sound files need the package soundfile: pip install 'shotrig[sound]'") from None
    try:
        file = stack.enter_context(soundfile.SoundFile(path))
    except soundfile.SoundFileError as error:
        raise RecordingError(f"{path} is not a sound file, or is damaged ({error}). Export it again.") from error
    if file.subtype not in _EXACT_FORMATS:
        raise RecordingError(
            f"{path}: its samples have the format {file.subtype_info}. Export uncompressed samples: integers of 8 to "
            "32 bits, or floats of 32 or 64 bits."
        )
    if _TRUNCATED in file.extra_info:
        raise RecordingError(
            f"{path} is truncated: its header states more samples than the file contains. Export it again."
        )
    bits = _INTEGER_BITS.get(file.subtype)

    # All tracks of a piece are read together; the cache serves the other tracks.
    @lru_cache(maxsize=1)
    def read_all(start: int, stop: int) -> Array:
        try:
            file.seek(start)
            samples: Array = file.read(stop - start, dtype="float64", always_2d=True)
        except soundfile.SoundFileError as error:
            raise RecordingError(f"{path} is damaged after sample {start} ({error}). Export it again.") from error
        if samples.shape[0] < stop - start:
            raise RecordingError(f"{path} ends at sample {start + samples.shape[0]} of {stop}. Export it again.")
        return samples

    def track_signal(number: int) -> Signal:
        def read(start: int, stop: int) -> Array:
            return read_all(start, stop)[:, number].copy()

        # The largest value of a two's complement integer, as a fraction of its negative end.
        full_scale = None if bits is None else 1.0 - 2.0 ** (1 - bits)
        name = f"track {number + 1}"
        return Signal(path.name, number + 1, name, "", file.frames, float(file.samplerate), read, full_scale=full_scale)

    return [track_signal(number) for number in range(file.channels)]
