"""Calls with wrong, malicious or excessive values disturb only the client that sends them.

The *witness* is a task of another client, whose samples must not depend on these calls.
"""

import contextlib
import random
import socket
import threading

import grpc
import nidaqmx
import numpy as np
import pytest
from google.protobuf import message_factory
from nidaqmx.constants import AcquisitionType
from nidaqmx.errors import DaqError
from nidaqmx.scale import Scale

import daq
from daq.extras.ni_device.clock import ManualClock
from daq.extras.ni_server.calls.handlers import handler_of
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.protocol import SERVICE, is_repeated, methods
from daq.extras.ni_server.served_instrument import Limits
from rig import load

RATE = 5120.0  # Hz
# Values of fields: valid values, limits, and values that a careless server would not expect.
STRINGS = (
    "",
    "cDAQ1Mod2/ai0",
    "cDAQ1Mod2/ai1:3",
    "cDAQ1Mod3/ao0",
    "cDAQ1Mod2",
    "a",
    "\0",
    "\x1b[31m",
    "9" * 5000,
    "x" * 70_000,
)
NUMBERS = (0.0, 1.0, -1.0, 5.0, -5.0, 100.0, 5120.0, 1e300, 1e-320, float("nan"), float("inf"))
INTEGERS = (0, 1, 2, 3, 10, 100, 10_178, 10_280, 10_348, 2**31 - 1)
VALUES_BY_TYPE = {
    "string": lambda rng: rng.choice(STRINGS),
    "bytes": lambda rng: rng.choice((b"", b"\0" * 7, b"\xff" * 1000)),
    "double": lambda rng: rng.choice(NUMBERS),
    "bool": lambda rng: rng.random() < 0.5,
}


def two_modules():
    """Return a scene with inputs at two modules; the witness uses one of them."""
    sensor = {"sensitivity": "100 mV/g", "noise": "20 ug/sqrt(Hz)"}
    channels = [{"name": "table", "at": "table", "accelerometer": sensor}]
    channels += [{"name": f"c{n}", "at": f"body {1 + n % 3}", "accelerometer": sensor} for n in range(7)]
    return load("bare-structure", {"channels": channels, "converter": {"preset": "NI 9234", "rate": "5120 Hz"}})


def connect_client(rig):
    """Return session options of a separate client."""
    return nidaqmx.GrpcSessionOptions(open_channel(rig.address), "")


def input_task_of(options, channels="cDAQ1Mod1/ai0:3", **timing):
    """Return a task with voltage inputs at `RATE`."""
    task = nidaqmx.Task(grpc_options=options)
    task.ai_channels.add_ai_voltage_chan(channels)
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def fill(message, rng, sessions, depth=0):
    """Fill fields of a message with random values; the names of sessions are those of `sessions`, or invalid."""
    for field in message.DESCRIPTOR.fields:
        if rng.random() < (0.1 if field.containing_oneof is None else 0.5):
            continue
        is_list, value_or_list = is_repeated(field), getattr(message, field.name)
        for _ in range(rng.choice((0, 1, 3)) if is_list else 1):
            if field.message_type is not None:
                submessage = message_factory.GetMessageClass(field.message_type)()
                if field.message_type.full_name == "nidevice_grpc.Session":
                    submessage.name = rng.choice((*sessions, *sessions, "nobody", *STRINGS[-3:]))
                elif depth < 3 and not field.message_type.GetOptions().map_entry:
                    fill(submessage, rng, sessions, depth + 1)
                else:
                    continue
                (value_or_list.add() if is_list else value_or_list).CopyFrom(submessage)
                continue
            value_type = next(
                (name for name in VALUES_BY_TYPE if field.type == getattr(field, f"TYPE_{name.upper()}")), ""
            )
            value = VALUES_BY_TYPE[value_type](rng) if value_type else rng.choice(INTEGERS)
            if field.name in ("timeout", "time_to_wait"):
                value = rng.choice((0.0, 0.01, float("nan")))
            if is_list and value_type != "string":
                value_or_list.append(value)
            elif not is_list:
                setattr(message, field.name, value)


def send(channel, name, data):
    """Send the bytes of a request to a call; return the bytes of the response."""
    return channel.unary_unary(f"/{SERVICE.full_name}/{name}")(data, timeout=20.0)


def open_event_stream(options, task, name):
    """Register for an event of a task; return the stream of events, which stays open."""
    method = next(method for method in methods() if method.name == name)
    request = method.request()
    request.task.name = task._handle.name
    if name == "RegisterEveryNSamplesEvent":
        request.n_samples, request.every_n_samples_event_type_raw = 100, 1
    if name == "RegisterSignalEvent":
        request.signal_id_raw = 12_491  # start trigger
    stream = options.grpc_channel.unary_stream(f"/{SERVICE.full_name}/{name}")(request.SerializeToString())
    # The server sends the metadata once the event is registered.
    stream.initial_metadata()
    return stream


def send_random_call(channel, method, rng, sessions):
    """Send a call with random fields, sometimes with damaged bytes; return the server's error, or ""."""
    request = method.request()
    fill(request, rng, sessions)
    data = bytearray(request.SerializeToString())
    n_damaged = rng.choice((0,) * 20 + (3,))  # bytes
    for _ in range(n_damaged if data else 0):
        data[rng.randrange(len(data))] = rng.randrange(256)
    try:
        response = send(channel, method.name, bytes(data))
    except grpc.RpcError as error:
        return error.details()
    if method.name == "CreateTask":
        sessions.append(method.response.FromString(response).task.name)
    return ""


def create_valid_task(channel, sessions):
    """Create a task that can run, and add it to the sessions."""
    methods_by_name = {method.name: method for method in methods()}
    sessions.append(methods_by_name["CreateTask"].response.FromString(send(channel, "CreateTask", b"")).task.name)
    request = methods_by_name["CreateAIVoltageChan"].request(
        physical_channel="cDAQ1Mod2/ai0", terminal_config_raw=-1, min_val=-5.0, max_val=5.0, units_raw=10_348
    )
    request.task.name = sessions[-1]
    send(channel, "CreateAIVoltageChan", request.SerializeToString())


def read_witness_during(actions, n_actions):
    """Read 2000 samples of the witness during other calls to the server; return them, shape (4, 2000)."""
    with (
        daq.connect(two_modules(), clock=ManualClock()) as rig,
        input_task_of(connect_client(rig), samps_per_chan=2000) as witness,
    ):
        witness.start()
        for action in actions(open_channel(rig.address)):
            rig.chassis.advance(round(2000 / n_actions * rig.chassis.rate / RATE))
            action()
        rig.chassis.advance(round(0.1 * rig.chassis.rate))
        return np.array(witness.read(2000, timeout=0.0))


def test_random_calls_disturb_only_their_client(capfd):
    rng, sessions, errors = random.Random(20), ["nobody"], []
    supported = [method for method in methods() if not method.streams and handler_of(method.name)]
    # Outputs drive the shaker, and change the readings of all clients by design.
    without_outputs = [method for method in supported if "AO" not in method.name and "Write" not in method.name]

    rng.shuffle(without_outputs)

    def calls(channel):
        for number, method in enumerate(without_outputs):
            if number % 20 == 0:
                create_valid_task(channel, sessions)
            yield lambda method=method: errors.append(send_random_call(channel, method, rng, sessions[-4:]))

    n_calls = len(without_outputs)
    disturbed = read_witness_during(calls, n_calls)
    assert not [text for text in errors if "fault" in text or "Exception" in text or "Stream removed" in text]
    assert "Traceback" not in capfd.readouterr().err
    np.testing.assert_array_equal(disturbed, read_witness_during(lambda channel: [lambda: None] * n_calls, n_calls))


@pytest.mark.parametrize(
    "call, hint",
    [
        (lambda rig: nidaqmx.Task("x" * 1_000_000, grpc_options=rig), "1000000 characters"),
        (lambda rig: nidaqmx.Task("a\0b", grpc_options=rig), "null character"),
        (lambda rig: Scale.create_polynomial_scale("s", [], [], grpc_options=rig), "empty"),
        (lambda rig: Scale.create_table_scale("s", [], [], grpc_options=rig), "empty"),
        (lambda rig: Scale.create_lin_scale("s", float("nan"), grpc_options=rig), "finite"),
        (lambda rig: Scale.create_polynomial_scale("s", [1.0] * 10_001, [1.0], grpc_options=rig), "entries"),
    ],
)
def test_error_names_the_invalid_value(call, hint):
    with daq.connect("bare-structure", clock=ManualClock()) as rig, pytest.raises(DaqError, match=hint):
        call(rig)


@pytest.mark.parametrize("points, order, forward", [(10**9, 3, 1.0), (1000, 999, 1.0), (5, 7, 1.0), (100, 3, 1e300)])
def test_impossible_polynomial_reversal_is_rejected(points, order, forward):
    from daq.extras.ni_device.settings.scales import reverse_polynomial

    with pytest.raises(daq.extras.ni_device.errors.DaqError, match="polynomial"):
        reverse_polynomial([0.0, forward], -1e10, 1e10, points, order)


def test_invalid_number_is_rejected_without_effect():
    with daq.connect(two_modules(), clock=ManualClock()) as rig, input_task_of(rig) as task:
        channel = task.ai_channels["cDAQ1Mod1/ai0"]
        with pytest.raises(DaqError, match="finite"):
            channel.ai_excit_val = float("nan")
        with pytest.raises(DaqError, match="positive"):
            task.timing.samp_clk_timebase_div = 0
        assert (channel.ai_excit_val, task.timing.samp_clk_rate) == (0.0, RATE)


def test_endless_wait_does_not_block_others():
    with daq.connect(two_modules(), clock="fast") as rig:
        channel, error_codes = open_channel(rig.address), []
        with input_task_of(nidaqmx.GrpcSessionOptions(channel, ""), samps_per_chan=100) as waiting:
            waiting.triggers.start_trigger.cfg_anlg_edge_start_trig("cDAQ1Mod1/ai0", trigger_level=4.9)
            waiting.start()

            def wait():
                with pytest.raises(DaqError) as caught:
                    waiting.read(100, timeout=-1.0)
                error_codes.append(caught.value.error_code)

            thread = threading.Thread(target=wait)
            thread.start()
            with input_task_of(connect_client(rig), "cDAQ1Mod2/ai0:2", samps_per_chan=100) as other:
                for _ in range(3):
                    assert np.shape(other.read(100)) == (3, 100)
            waiting.stop()
            thread.join()
    assert len(error_codes) == 1


def test_unresponsive_client_does_not_stop_clock():
    with daq.connect(two_modules(), clock="fast") as rig:
        timing = {"sample_mode": AcquisitionType.CONTINUOUS, "samps_per_chan": 100}
        with (
            input_task_of(connect_client(rig), **timing) as unresponsive,
            input_task_of(connect_client(rig), "cDAQ1Mod2/ai0:2", **timing) as other,
        ):
            unresponsive.register_every_n_samples_acquired_into_buffer_event(1, lambda *_: 0)
            unresponsive.start()
            assert np.shape(other.read(250)) == (3, 250)


@pytest.mark.parametrize("seconds", [b"", b"soon", b"\xff"])
def test_invalid_time_is_rejected(seconds):
    with daq.connect("bare-structure", clock="fast") as rig, pytest.raises(grpc.RpcError, match="a number of"):
        open_channel(rig.address).unary_unary("/shotrig.Bench/Pass")(seconds, timeout=20.0)


def test_too_many_calls_are_rejected():
    with daq.connect("bare-structure", clock="fast", limits=Limits(max_calls_per_client=3)) as rig:
        excessive_client = connect_client(rig)
        with input_task_of(excessive_client, "cDAQ1Mod1/ai0") as task:
            streams = [
                open_event_stream(excessive_client, task, name)
                for name in ("RegisterDoneEvent", "RegisterEveryNSamplesEvent", "RegisterSignalEvent")
            ]
            with pytest.raises(DaqError, match="3 unfinished calls"):
                task.start()
            with input_task_of(connect_client(rig), "Dev7/ai0", samps_per_chan=100) as other:
                assert len(other.read(100)) == 100
            for stream in streams:
                stream.cancel()


def test_too_many_scales_are_rejected(monkeypatch):
    monkeypatch.setattr("daq.extras.ni_device.settings.storage.MAX_SAVED", 2)
    with daq.connect("bare-structure", clock=ManualClock()) as rig:
        for name in ("a", "b", "a"):
            Scale.create_lin_scale(name, 2.0, grpc_options=rig)
        with pytest.raises(DaqError, match="the maximum"):
            Scale.create_lin_scale("c", 2.0, grpc_options=rig)


def test_idle_connections_are_limited(monkeypatch):
    monkeypatch.setattr("daq.extras.ni_server.service._MAX_CONNECTIONS", 5)
    with daq.connect("bare-structure", clock="fast") as rig, contextlib.ExitStack() as idle:
        host, _, port = rig.address.rpartition(":")
        connections = [idle.enter_context(socket.create_connection((host, int(port)), timeout=60.0)) for _ in range(20)]
        n_closed = 0
        for connection in connections:
            # The server sends its settings to an accepted client, and closes the connections of others.
            with contextlib.suppress(ConnectionResetError):
                n_closed += 0 if connection.recv(1) else 1
                continue
            n_closed += 1
        assert n_closed >= 15
