"""Read and write calls with any value of any field return a valid response, or an error of the driver."""

import grpc
import nidaqmx
import numpy as np
import pytest
from google.protobuf import message_factory
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nidaqmx.constants import AcquisitionType, ReadRelativeTo
from nidaqmx.error_codes import DAQmxErrors

import daq
import rig
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.protocol import SERVICE, methods

COUNT_TYPES = {"I16": np.int16, "I32": np.int32, "U16": np.uint16, "U32": np.uint32}
# Calls that read or write samples.
TRANSFER_METHODS = [method for method in methods() if method.name.startswith(("Read", "Write"))]
FEW_EXAMPLES = settings(
    max_examples=6, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def scene(bits):
    """Return a scene whose input and output have this resolution."""
    converter = {"rate": "5120 Hz", "bits": bits, "range": "5 V"}
    output = {"range": "10 V", "bits": bits}
    return rig.load("bare-structure", {"converter": converter, "shaker.output": output})


@pytest.fixture(scope="module", params=[16, 24])
def bench(request):
    """Return a connection to the scene, its resolution in bits, and a channel to the server."""
    with daq.connect(scene(request.param), clock="fast") as connection:
        yield connection, request.param, open_channel(connection.address)


def send(channel, method, **fields):
    """Send a request with these fields; return the response."""
    message = message_factory.GetMessageClass(SERVICE.methods_by_name[method].input_type)(**fields)
    response = message_factory.GetMessageClass(SERVICE.methods_by_name[method].output_type)
    call = channel.unary_unary(
        f"/{SERVICE.full_name}/{method}",
        request_serializer=lambda request: request.SerializeToString(),
        response_deserializer=response.FromString,
    )
    return call(message)


def code_of(error):
    """Return the driver's code of an error; fail for other errors."""
    codes = [int(value) for key, value in error.trailing_metadata() if key == "ni-error"]
    assert error.code() is grpc.StatusCode.UNKNOWN and codes and codes[0] < 0, error.details()
    assert "unexpected error" not in error.details()
    return codes[0]


def values_of(field):
    """Return a strategy for all values of a field's type."""
    strategies = {
        field.CPPTYPE_INT32: st.integers(-(2**31), 2**31 - 1),
        field.CPPTYPE_UINT32: st.integers(0, 2**32 - 1),
        field.CPPTYPE_INT64: st.integers(-(2**63), 2**63 - 1),
        field.CPPTYPE_UINT64: st.integers(0, 2**64 - 1),
        field.CPPTYPE_DOUBLE: st.floats() | st.floats(-10.0, 10.0),
        field.CPPTYPE_BOOL: st.booleans(),
        field.CPPTYPE_ENUM: st.integers(-(2**31), 2**31 - 1),
        field.CPPTYPE_STRING: st.binary(max_size=40)
        if field.type == field.TYPE_BYTES
        else st.text(st.characters(exclude_categories=["Cs"]), max_size=40),
    }
    return strategies[field.cpp_type]


@st.composite
def requests(draw, method, task):
    """Draw the fields of a request that names this task."""
    request_fields = SERVICE.methods_by_name[method].input_type.fields
    empty = message_factory.GetMessageClass(SERVICE.methods_by_name[method].input_type)()
    fields = {"task": {"name": task}} if "task" in [field.name for field in request_fields] else {}
    for field in request_fields:
        if field.name == "waveforms" and "Analog" in method:
            fields[field.name] = [{"y_data": draw(st.lists(st.floats(), max_size=4))}]
        if field.message_type is None and draw(st.integers(0, 4)):
            value = values_of(field)
            if field.name == "timeout":
                value = st.sampled_from([0.0, 0.01, float("nan")])
            if field.name.startswith(("num_samps", "array_size")):
                value = st.integers(-1 if field.name.startswith("num") else 0, 8) | value
            is_list = hasattr(getattr(empty, field.name), "extend")
            fields[field.name] = draw(st.lists(value, max_size=8) if is_list else value)
    return fields


@pytest.mark.parametrize("bench", [16], indirect=True)
@pytest.mark.parametrize("method", [method.name for method in TRANSFER_METHODS])
def test_any_request_gives_response_or_driver_error(bench, method):
    connection, _, channel = bench
    with nidaqmx.Task("in", grpc_options=connection) as inputs, nidaqmx.Task("out", grpc_options=connection) as outputs:
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:1")
        inputs.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
        outputs.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        inputs.start()

        @FEW_EXAMPLES
        @given(st.data())
        def send_any_request(data):
            fields = data.draw(requests(method, data.draw(st.sampled_from(["in", "out", ""]))))
            try:
                send(channel, method, **fields)
            except grpc.RpcError as error:
                code_of(error)

        send_any_request()


@pytest.mark.parametrize("count_type", COUNT_TYPES)
def test_counts_read_are_twos_complement(bench, count_type):
    connection, bits, channel = bench
    with (
        nidaqmx.Task("signed", grpc_options=connection) as task,
        nidaqmx.Task("step", grpc_options=connection) as output,
    ):
        # The test of the scene may have ended. A step of the table makes the structure vibrate.
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.write(-0.001 if connection.chassis.last_volts[0] > 0.0 else 0.001)
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3")
        task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=200)
        request = {"task": {"name": "signed"}, "num_samps_per_chan": 200, "timeout": 10.0, "array_size_in_samps": 800}
        task.start()
        signed = np.array(send(channel, "ReadBinaryI32", **request).read_array)
        task.in_stream.relative_to, task.in_stream.offset = ReadRelativeTo.FIRST_SAMPLE, 0
        if bits > np.iinfo(COUNT_TYPES[count_type]).bits:
            with pytest.raises(grpc.RpcError) as caught:
                send(channel, f"ReadBinary{count_type}", **request)
            assert code_of(caught.value) == DAQmxErrors.READ_DATA_TYPE_TOO_SMALL
            return
        response = send(channel, f"ReadBinary{count_type}", **request)
    assert signed.min() < 0 < signed.max()
    assert np.array_equal(response.read_array, signed.astype(COUNT_TYPES[count_type]))


@pytest.mark.parametrize("count_type", COUNT_TYPES)
def test_counts_written_are_twos_complement(bench, count_type):
    connection, bits, channel = bench
    width = np.iinfo(COUNT_TYPES[count_type]).bits
    with nidaqmx.Task("counts", grpc_options=connection) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output_volts = connection.chassis.last_volts

        @settings(FEW_EXAMPLES, max_examples=40)
        @given(st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1))
        @example(-1)
        def write(count):
            number = int(np.int64(count).astype(COUNT_TYPES[count_type]))
            samples = {"num_samps_per_chan": 1, "write_array": [number], "auto_start": True}
            send(channel, f"WriteBinary{count_type}", task={"name": "counts"}, **samples)
            assert output_volts[0] == count * 10.0 / 2 ** (bits - 1)  # range ±10 V

        if bits <= width:
            write()
            return
        with pytest.raises(grpc.RpcError) as caught:
            write()
        assert code_of(caught.value) == DAQmxErrors.WRITE_DATA_TYPE_TOO_SMALL
