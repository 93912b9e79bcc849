"""Clients without generated code can use the server: they obtain its description by gRPC reflection."""

import grpc
import nidaqmx
import pytest
from google.protobuf import descriptor_pool, message_factory
from nidaqmx.error_codes import DAQmxErrors

import daq
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.discovery import SERVICES

RATE = 5120.0  # Hz


class ReflectedClient:
    """A client that knows only the reflection service, by which the server describes all other calls."""

    def __init__(self, address):
        from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

        self.channel = open_channel(address)
        self.database = ProtoReflectionDescriptorDatabase(self.channel)
        self.pool = descriptor_pool.DescriptorPool(self.database)

    def services(self):
        """Return the names of the services that the server describes."""
        return set(self.database.get_services())

    def call(self, service, method, /, **fields):
        """Send a request with these fields; return the response."""
        description = self.pool.FindServiceByName(service).FindMethodByName(method)
        request = message_factory.GetMessageClass(description.input_type)
        response = message_factory.GetMessageClass(description.output_type)
        send = self.channel.unary_unary(
            f"/{service}/{method}",
            request_serializer=request.SerializeToString,
            response_deserializer=response.FromString,
        )
        return send(request(**fields))

    def daqmx(self, method, **fields):
        """Call a method of the instrument's service; return the response."""
        return self.call("nidaqmx_grpc.NiDAQmx", method, **fields)


@pytest.fixture(scope="module")
def rig():
    with daq.connect("bare-structure", clock="fast") as connection:
        yield connection


@pytest.fixture(scope="module")
def client(rig):
    return ReflectedClient(rig.address)


def test_reflection_lists_all_services(client):
    assert client.services() == {service.full_name for service in SERVICES}


def test_client_of_reflection_writes_and_reads(client):
    written_task, read_task = (client.daqmx("CreateTask", session_name=name).task for name in ("out", "in"))
    timing = {"rate": RATE, "active_edge": "EDGE1_RISING", "sample_mode": "ACQUISITION_TYPE_FINITE_SAMPS"}
    client.daqmx(
        "CreateAOVoltageChan",
        task=written_task,
        physical_channel="cDAQ1Mod2/ao0",
        min_val=-10,
        max_val=10,
        units_raw=10348,  # V
    )
    client.daqmx(
        "CreateAIVoltageChan",
        task=read_task,
        physical_channel="cDAQ1Mod1/ai0",
        min_val=-500,
        max_val=500,
        terminal_config_raw=-1,
        units_raw=10348,
    )
    for task in (written_task, read_task):
        client.daqmx("CfgSampClkTiming", task=task, samps_per_chan=500, **timing)
    client.daqmx("WriteAnalogF64", task=written_task, num_samps_per_chan=500, timeout=10.0, write_array=[5.0] * 500)
    client.daqmx("StartTask", task=written_task)
    result = client.daqmx(
        "ReadAnalogF64", task=read_task, num_samps_per_chan=500, timeout=10.0, array_size_in_samps=500
    )
    client.daqmx("ClearTask", task=written_task)
    client.daqmx("ClearTask", task=read_task)
    assert result.samps_per_chan_read == 500
    assert max(map(abs, result.read_array)) > 0.01  # V; the output has moved the table


def test_devices_are_enumerated(rig, client):
    result = client.call("nidevice_grpc.SessionUtilities", "EnumerateDevices").devices
    devices = rig.chassis.devices
    assert [(device.name, device.model) for device in result] == [
        (name, devices.module(name).product_type) for name in devices.names
    ]


def test_health_is_serving(client):
    for service in ("", "nidaqmx_grpc.NiDAQmx"):
        assert client.call("grpc.health.v1.Health", "Check", service=service).status == 1  # SERVING


def test_reservation_excludes_other_clients(client):
    service = "nidevice_grpc.SessionUtilities"
    mine, other = ({"reservation_id": "rig", "client_id": name} for name in ("mine", "other"))
    assert client.call(service, "Reserve", **mine).is_reserved
    assert not client.call(service, "IsReservedByClient", **other).is_reserved
    assert not client.call(service, "Unreserve", **other).is_unreserved
    assert client.call(service, "Unreserve", **mine).is_unreserved
    assert client.call(service, "Reserve", **other).is_reserved


def test_reset_of_server_ends_tasks():
    with daq.connect("bare-structure", clock="fast") as connection:
        task = nidaqmx.Task("left", grpc_options=connection)
        client = ReflectedClient(connection.address)
        assert client.call("nidevice_grpc.SessionUtilities", "ResetServer").is_server_reset
        with pytest.raises(nidaqmx.errors.DaqError) as caught:
            task.start()
        assert caught.value.error_code == DAQmxErrors.INVALID_TASK


@pytest.mark.parametrize("method", ["grpc.health.v1.Health/Check", "grpc.reflection.v1alpha.ServerReflection/X"])
def test_unreadable_request_is_not_logged(rig, method, caplog):
    with pytest.raises(grpc.RpcError):
        open_channel(rig.address).unary_unary(f"/{method}")(b"\xff\xff\xff")
    assert not caplog.records
