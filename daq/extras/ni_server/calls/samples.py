"""Handlers of the calls that read and write samples."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.extras.ni_device.errors import Code, DaqError, unsupported
from daq.extras.ni_device.task import Task
from daq.extras.ni_device.task_input import ReadResult
from daq.extras.ni_server.calls.call import Call, Handler, ResponseFields

# NI's number for the order of samples in an array: all samples of one channel, then all of the next channel.
_BY_CHANNEL = 0
# Time from the beginning of 1904 to the beginning of 1970 (UTC) [s].
_SECONDS_1904_TO_1970 = 2_082_844_800
# Integer types in which calls transfer counts, by the names in the calls; unsigned types contain the two's complement.
_CountType = type[np.signedinteger[Any]] | type[np.unsignedinteger[Any]]
_COUNT_TYPES: dict[str, _CountType] = {"I16": np.int16, "I32": np.int32, "U16": np.uint16, "U32": np.uint32}


def _check_width(count_type: _CountType, width: int, code: Code) -> None:
    """Raise `DaqError` with the code if counts of `width` bits do not fit into the integer type."""
    bits = np.iinfo(count_type).bits
    if width > bits:
        raise DaqError(
            f"the converter's counts have {width} bits, but this call transfers {bits} bits. Use the call for 32 bits.",
            code,
            samples_done=0,
        )


def _check_array_size(size: int, needed: int, unit: str) -> None:
    """Check that the array of the client is large enough; both sizes are in "samples" or "bytes" (`unit`)."""
    if needed > size:
        raise DaqError(
            f"the array has room for {size} {unit}, but the read returns {needed}. Use a larger array.",
            Code.READ_BUFFER_TOO_SMALL,
            samples_done=0,
        )


def _read(count_type: _CountType | None = None) -> Handler:
    """Return the handler that reads samples as readings in units, or as counts of an integer type."""

    def read(call: Call) -> ResponseFields:
        fields, task = call.fields, call.task
        task.settings.require("ai")
        if count_type is not None:
            _check_width(count_type, 8 * task.raw_width, Code.READ_DATA_TYPE_TOO_SMALL)
        channels, samples = len(task.settings.indices_to_read()), fields["num_samps_per_chan"]

        def check(required: int) -> None:
            _check_array_size(fields["array_size_in_samps"], required * channels, "samples")
            call.instrument.check_size(required * channels * 8)

        result = task.read(samples, fields["timeout"], count_type is not None, check)
        by_channel, values = fields["fill_mode"] == _BY_CHANNEL, result.samples
        samples_read = values.shape[1]
        if count_type is not None:
            values = values.astype(count_type)
        if by_channel and result.error is None and samples_read < samples:
            # A finite task has ended: pad the samples, so each channel begins where the client expects it.
            values = np.pad(values, ((0, 0), (0, samples - samples_read)))
        values = values if by_channel else values.T
        return _with_status(call, result, {"read_array": values, "samps_per_chan_read": samples_read})

    return read


def _with_status(call: Call, result: ReadResult, response: ResponseFields) -> ResponseFields:
    """Add the error of a read to its response as status; raise the error if there are no samples."""
    error = result.error
    if error is None:
        return response
    samples_read = result.samples.shape[1]
    if not samples_read:
        raise DaqError(str(error), error.code, samples_done=0)
    call.instrument.store_error(call.peer, error, call.task.name)
    return response | {"status": error.code}


def _read_scalar(call: Call) -> ResponseFields:
    result = call.task.read(1, call.fields["timeout"])
    if result.error is not None:
        raise result.error
    return {"value": float(result.samples[0, 0])}


def _read_raw(call: Call) -> ResponseFields:
    """Read counts as the bytes of 16-bit or 32-bit integers, according to the resolution of the converter."""
    fields, task = call.fields, call.task
    task.settings.require("ai")
    width, array_bytes = task.raw_width, fields["array_size_in_bytes"]
    channels, samples = len(task.settings.indices_to_read()), fields["num_samps_per_chan"]
    call.instrument.check_size(array_bytes)

    def check(required: int) -> None:
        _check_array_size(array_bytes, required * channels * width, "bytes")

    result = task.read(samples, fields["timeout"], True, check)
    count_type = np.int16 if width == 2 else np.int32
    data = result.samples.T.astype(count_type).tobytes().ljust(array_bytes, b"\0")
    count = result.samples.shape[1]
    return _with_status(call, result, {"read_array": data, "samps_read": count, "num_bytes_per_samp": channels * width})


def _read_waveforms(call: Call) -> ResponseFields:
    """Read samples with their times (bit 0 of the mode) and names and units (bit 1)."""
    from ni.protobuf.types import waveform_conversion
    from ni.protobuf.types.waveform_pb2 import DoubleAnalogWaveform, WaveformAttributeValue

    task, mode = call.task, call.fields.get("waveform_attribute_mode", 0)
    result = task.read(call.fields["num_samps_per_chan"], call.fields["timeout"])
    assert waveform_conversion is not None
    waveforms = []
    for index, samples in zip(task.settings.indices_to_read(), result.samples, strict=True):
        channel = task.settings.channels[index]
        waveform = DoubleAnalogWaveform(y_data=samples.tolist())
        if mode & 1:
            start = task.input.time_of_sample(result.first)
            # Waveform times count from 1904, in seconds and in fractions of 2^-64 s.
            seconds, remainder = divmod(start, 10**9)
            waveform.t0.seconds = seconds + _SECONDS_1904_TO_1970
            waveform.t0.fractional_seconds = remainder * 2**64 // 10**9
            waveform.dt = 1.0 / task.settings.rate
        if mode & 2:
            waveform.attributes["NI_ChannelName"].CopyFrom(WaveformAttributeValue(string_value=channel.name))
            unit = "Volts" if channel.unit == "V" else channel.unit
            waveform.attributes["NI_UnitDescription"].CopyFrom(WaveformAttributeValue(string_value=unit))
        waveforms.append(waveform)
    return _with_status(call, result, {"waveforms": waveforms, "samps_per_chan_read": result.samples.shape[1]})


def _rows_by_channel(task: Task, data: NDArray[np.float64], samples: int, by_channel: bool) -> NDArray[np.float64]:
    """Return an array of a client, in volts or counts, in the shape (channels, samples).

    `samples` is the number per channel. With `by_channel`, the array has all samples of one channel, then all of the
    next channel. Otherwise it has the first samples of all channels, then the second samples.
    """
    channels = len(task.settings.channels) or 1
    if data.size != channels * samples:
        raise DaqError(
            f"the data have {data.size} values; the task has {channels} channels. Write {samples} samples for each.",
            Code.WRITE_NUM_CHANS_MISMATCH,
            samples_done=0,
        )
    return data.reshape(channels, samples) if by_channel else data.reshape(samples, channels).T


def _write(count_type: _CountType | None = None) -> Handler:
    """Return the handler that writes samples in volts, or as counts of an integer type."""

    def write(call: Call) -> ResponseFields:
        fields, task = call.fields, call.task
        if count_type is None:
            data = np.asarray(fields["write_array"], dtype=np.float64)
        else:
            _check_width(count_type, _count_bits(task), Code.WRITE_DATA_TYPE_TOO_SMALL)
            limits, numbers = np.iinfo(count_type), np.array(fields["write_array"], dtype=np.int64)
            outside = (numbers < limits.min) | (numbers > limits.max)
            if outside.any():
                raise DaqError(
                    f"{numbers[outside][0]} is not a {limits.bits}-bit number. Write {limits.min} to {limits.max}.",
                    Code.INVALID_AO_DATA_WRITE,
                    samples_done=0,
                )
            data = numbers.astype(f"i{limits.bits // 8}").astype(np.float64)
        values = _rows_by_channel(task, data, fields["num_samps_per_chan"], fields["data_layout"] == _BY_CHANNEL)
        volts = values if count_type is None else values * _volts_per_count(task)
        return {"samps_per_chan_written": task.write(volts, fields["auto_start"], fields["timeout"])}

    return write


def _count_bits(task: Task) -> int:
    """Return the width of the counts of a task's outputs, bits."""
    task.settings.require("ao")
    return 16 if all((channel.module.output_bits or 32) <= 16 for channel in task.settings.channels) else 32


def _volts_per_count(task: Task) -> NDArray[np.float64]:
    """Return the volts per count of each output, shape (channels, 1)."""
    volts_per_count = []
    for channel in task.settings.channels:
        if channel.module.output_bits is None:
            raise unsupported("an unscaled write", "This output is ideal and has no counts. Write volts.")
        volts_per_count.append([channel.module.output_range / 2.0 ** (channel.module.output_bits - 1)])
    return np.array(volts_per_count)


def _write_scalar(call: Call) -> None:
    fields = call.fields
    call.task.write(np.array([[fields["value"]]]), fields["auto_start"], fields["timeout"])


def _write_raw(call: Call) -> ResponseFields:
    fields, task = call.fields, call.task
    count_type = np.dtype(f"i{_count_bits(task) // 8}")
    # Bytes of an incomplete number at the end of the array are ignored.
    n_values = fields["num_samps"] * len(task.settings.channels)
    count = min(n_values, len(fields["write_array"]) // count_type.itemsize)
    data = np.frombuffer(fields["write_array"], dtype=count_type, count=max(count, 0))
    counts = _rows_by_channel(task, data.astype(float), fields["num_samps"], by_channel=False)
    written = task.write(counts * _volts_per_count(task), fields["auto_start"], fields["timeout"])
    return {"samps_per_chan_written": written}


def _write_waveforms(call: Call) -> ResponseFields:
    fields = call.fields
    rows = [np.array(waveform.y_data) for waveform in fields["waveforms"]]
    if len({row.size for row in rows}) > 1:
        raise DaqError("the waveforms differ in length. Write the same number of samples for each.", -200101, 0)
    volts = np.stack(rows) if rows else np.zeros((0, 0))
    return {"samps_per_chan_written": call.task.write(volts, fields["auto_start"], fields["timeout"])}


CALLS: dict[str, Handler] = {
    "ReadAnalogF64": _read(),
    "ReadAnalogScalarF64": _read_scalar,
    **{f"ReadBinary{name}": _read(count_type) for name, count_type in _COUNT_TYPES.items()},
    "ReadRaw": _read_raw,
    "ReadAnalogWaveforms": _read_waveforms,
    "WriteAnalogF64": _write(),
    "WriteAnalogScalarF64": _write_scalar,
    **{f"WriteBinary{name}": _write(count_type) for name, count_type in _COUNT_TYPES.items()},
    "WriteRaw": _write_raw,
    "WriteAnalogWaveforms": _write_waveforms,
}
