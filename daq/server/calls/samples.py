"""Calls that read and write samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.errors import Code, DaqError, unsupported
from daq.instrument.task import Task
from daq.instrument.task_reading import Reading, raw_width, time_of_sample
from daq.instrument.task_reading import read as read_task
from daq.instrument.task_writing import write as write_task
from daq.server.calls.call import Answer, Call

_BY_CHANNEL = 0


def _read(raw: bool = False, name: str = "read_array") -> Callable[[Call], Answer]:
    def read(call: Call) -> Answer:
        given = call.fields
        samples, size = given["num_samps_per_chan"], given.get("array_size_in_samps", 0)
        task = call.task
        if samples > 0 and samples * len(task.settings.rows_to_read()) > size:
            raise DaqError(
                f"the array has room for {size} samples, {samples} of {len(task.settings.rows_to_read())} channels are "
                "to be read: make it larger",
                Code.READ_BUFFER_TOO_SMALL,
                done=0,
            )
        call.server.check_size(max(samples, 0) * len(task.settings.rows_to_read()) * 8)
        reading = read_task(task, samples, given["timeout"], raw)
        by_channel, values = given["fill_mode"] == _BY_CHANNEL, reading.samples
        if by_channel and reading.error is None and values.shape[1] < samples:
            # All that a finite task had left: each channel keeps its place in the array.
            values = np.pad(values, ((0, 0), (0, samples - values.shape[1])))
        values = values if by_channel else values.T
        return _told(call, reading, {name: values, "samps_per_chan_read": reading.samples.shape[1]})

    return read


def _told(call: Call, reading: Reading, answer: Answer) -> Answer:
    """Give what was read with the reason why there is no more, if there should be."""
    error = reading.error
    if error is None:
        return answer
    done = reading.samples.shape[1]
    if not done:
        raise DaqError(str(error), error.code, done=0)
    call.server.remember(call.peer, error, call.task.name)
    return answer | {"status": error.code}


def _read_scalar(call: Call) -> Answer:
    reading = read_task(call.task, 1, call.fields["timeout"])
    if reading.error is not None:
        raise reading.error
    return {"value": float(reading.samples[0, 0])}


def _read_raw(call: Call) -> Answer:
    given, task = call.fields, call.task
    width = raw_width(task)
    channels = len(task.settings.rows_to_read())
    samples = given["num_samps_per_chan"]
    if samples > 0 and samples * channels * width > given["array_size_in_bytes"]:
        raise DaqError(
            f"the array has room for {given['array_size_in_bytes']} bytes, {samples * channels * width} are to be "
            "read: make it larger",
            Code.READ_BUFFER_TOO_SMALL,
            done=0,
        )
    reading = read_task(task, samples, given["timeout"], raw=True)
    kind = np.int16 if width == 2 else np.int32
    data = reading.samples.T.astype(kind).tobytes().ljust(given["array_size_in_bytes"], b"\0")
    count = reading.samples.shape[1]
    return _told(
        call, reading, {"read_array": data, "samps_read": count, "num_bytes_per_samp": channels * width}
    )


def _read_waveforms(call: Call) -> Answer:
    from ni.protobuf.types import waveform_conversion
    from ni.protobuf.types.waveform_pb2 import DoubleAnalogWaveform, WaveformAttributeValue

    task, mode = call.task, call.fields.get("waveform_attribute_mode", 0)
    reading = read_task(task, call.fields["num_samps_per_chan"], call.fields["timeout"])
    assert waveform_conversion is not None
    found = []
    for row, samples in zip(task.settings.rows_to_read(), reading.samples, strict=True):
        channel = task.settings.channels[row]
        waveform = DoubleAnalogWaveform(y_data=samples.tolist())
        if mode & 1:
            start = time_of_sample(task, reading.first)
            # The waveform's time counts from 1904, in seconds and 2^-64 of one.
            seconds, rest = divmod(start, 10**9)
            waveform.t0.seconds = seconds + 2_082_844_800
            waveform.t0.fractional_seconds = rest * 2**64 // 10**9
            waveform.dt = 1.0 / task.settings.rate
        if mode & 2:
            waveform.attributes["NI_ChannelName"].CopyFrom(WaveformAttributeValue(string_value=channel.name))
            unit = "Volts" if channel.unit == "V" else channel.unit
            waveform.attributes["NI_UnitDescription"].CopyFrom(WaveformAttributeValue(string_value=unit))
        found.append(waveform)
    return _told(call, reading, {"waveforms": found, "samps_per_chan_read": reading.samples.shape[1]})


def _table(task: Task, data: NDArray[np.float64], samples: int, by_channel: bool) -> NDArray[np.float64]:
    """Put samples into rows, one for each channel."""
    channels = len(task.settings.channels) or 1
    if data.size != channels * samples:
        raise DaqError(
            f"the data have {data.size} samples, {samples} for each of the task's {channels} channels were "
            "announced",
            Code.WRITE_NUM_CHANS_MISMATCH,
            done=0,
        )
    return data.reshape(channels, samples) if by_channel else data.reshape(samples, channels).T


def _write(
    scale: Callable[[Task, NDArray[Any]], NDArray[np.float64]] | None = None,
) -> Callable[[Call], Answer]:
    def write(call: Call) -> Answer:
        given, task = call.fields, call.task
        data = np.asarray(given["write_array"], dtype=np.float64)
        table = _table(task, data, given["num_samps_per_chan"], given["data_layout"] == _BY_CHANNEL)
        volts = table if scale is None else scale(task, table)
        return {"samps_per_chan_written": write_task(task, volts, given["auto_start"], given["timeout"])}

    return write


def _from_counts(task: Task, counts: NDArray[Any]) -> NDArray[np.float64]:
    """Turn converter counts into volts."""
    bits = task.settings.channels[0].module.output_bits if task.settings.channels else None
    if bits is None:
        raise unsupported("an unscaled write", "The rig's output has no counts: write volts.")
    return counts * (task.settings.channels[0].module.output_range / 2.0 ** (bits - 1))


def _write_scalar(call: Call) -> Answer:
    given = call.fields
    write_task(call.task, np.array([[given["value"]]]), given["auto_start"], given["timeout"])
    return {}


def _write_raw(call: Call) -> Answer:
    given, task = call.fields, call.task
    task.settings.require("ao")
    kind = np.int16 if (task.settings.channels[0].module.output_bits or 32) <= 16 else np.int32
    # What is left over of an array that is no whole number of samples is not put out.
    whole = given["num_samps"] * len(task.settings.channels)
    count = min(whole, len(given["write_array"]) // np.dtype(kind).itemsize)
    data = np.frombuffer(given["write_array"], dtype=kind, count=max(count, 0))
    table = _table(task, data.astype(float), given["num_samps"], by_channel=False)
    written = write_task(task, _from_counts(task, table), given["auto_start"], given["timeout"])
    return {"samps_per_chan_written": written}


def _write_waveforms(call: Call) -> Answer:
    given = call.fields
    rows = [np.array(each.y_data) for each in given["waveforms"]]
    if len({row.size for row in rows}) > 1:
        raise DaqError("the waveforms differ in length: write as many samples for each channel", -200101, 0)
    volts = np.stack(rows) if rows else np.zeros((0, 0))
    return {"samps_per_chan_written": write_task(call.task, volts, given["auto_start"], given["timeout"])}


CALLS: dict[str, Callable[[Call], Answer]] = {
    "ReadAnalogF64": _read(),
    "ReadAnalogScalarF64": _read_scalar,
    **{f"ReadBinary{kind}": _read(raw=True) for kind in ("I16", "I32", "U16", "U32")},
    "ReadRaw": _read_raw,
    "ReadAnalogWaveforms": _read_waveforms,
    "WriteAnalogF64": _write(),
    "WriteAnalogScalarF64": _write_scalar,
    **{f"WriteBinary{kind}": _write(_from_counts) for kind in ("I16", "I32", "U16", "U32")},
    "WriteRaw": _write_raw,
    "WriteAnalogWaveforms": _write_waveforms,
}
