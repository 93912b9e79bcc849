"""Converts a protocol descriptor to the text of a .proto file, for compilers of all languages.

Reference: the grammar at https://protobuf.dev/reference/protobuf/proto3-spec/. Options are omitted, except those that
change the meaning of the text or the bytes: `allow_alias`, `packed`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from google.protobuf import descriptor_pb2

_FIELD = descriptor_pb2.FieldDescriptorProto
_INDENT = "  "


def proto_text(file: Any) -> str:
    """Return the text of a .proto file, given its descriptor in syntax proto3."""
    described = descriptor_pb2.FileDescriptorProto()
    file.CopyToProto(described)
    lines = ['syntax = "proto3";', ""]
    lines += [f'import "{path}";' for path in described.dependency]
    lines += ["", f"package {described.package};", ""]
    for enum in described.enum_type:
        lines += [*_enum(enum), ""]
    for message in described.message_type:
        lines += [*_message(message, f".{described.package}"), ""]
    for service in described.service:
        lines += [*_block(f"service {service.name}", map(_method, service.method)), ""]
    return "\n".join(lines)


def _block(declaration: str, body: Iterator[str] | Any) -> Iterator[str]:
    """Yield the lines of a declaration with a body in braces, which is indented."""
    yield f"{declaration} {{"
    for line in body:
        yield f"{_INDENT}{line}"
    yield "}"


def _method(method: Any) -> str:
    request_type = f"{'stream ' if method.client_streaming else ''}{method.input_type}"
    response_type = f"{'stream ' if method.server_streaming else ''}{method.output_type}"
    return f"rpc {method.name}({request_type}) returns ({response_type});"


def _enum(enum: Any) -> Iterator[str]:
    alias = ["option allow_alias = true;"] if enum.options.allow_alias else []
    return _block(f"enum {enum.name}", [*alias, *(f"{member.name} = {member.number};" for member in enum.value)])


def _message(message: Any, scope: str) -> Iterator[str]:
    """Yield the lines of a message type; `scope` is the full name of the package or message that contains it."""
    scope = f"{scope}.{message.name}"
    maps = {f"{scope}.{nested.name}": nested for nested in message.nested_type if nested.options.map_entry}
    body: list[str] = []
    for enum in message.enum_type:
        body += _enum(enum)
    for nested in message.nested_type:
        body += [] if nested.options.map_entry else _message(nested, scope)
    written_oneofs: set[int] = set()  # indices
    for field in message.field:
        if not _in_oneof(field):
            body.append(_field(field, maps))
        elif field.oneof_index not in written_oneofs:
            written_oneofs.add(field.oneof_index)
            members = [other for other in message.field if _in_oneof(other) and other.oneof_index == field.oneof_index]
            name = message.oneof_decl[field.oneof_index].name
            body += _block(f"oneof {name}", [_field(field, maps) for field in members])
    return _block(f"message {message.name}", body)


def _in_oneof(field: Any) -> bool:
    """Return whether a field belongs to an explicit oneof; every optional field has an implicit oneof."""
    return field.HasField("oneof_index") and not field.proto3_optional


def _field(field: Any, maps: dict[str, Any]) -> str:
    """Return the line of a field; `maps` are the descriptors of the map entry types by full name."""
    entry = maps.get(field.type_name)
    if entry is not None:
        key, value = (_type(field) for field in entry.field)
        return f"map<{key}, {value}> {field.name} = {field.number};"
    repeated = field.label == _FIELD.LABEL_REPEATED
    label = "repeated " if repeated else "optional " if field.proto3_optional else ""
    packed = f" [packed = {str(field.options.packed).lower()}]" if field.options.HasField("packed") else ""
    return f"{label}{_type(field)} {field.name} = {field.number}{packed};"


def _type(field: Any) -> str:
    """Return the name of a field's type; messages and enumerations by their full name."""
    return str(field.type_name) or _FIELD.Type.Name(field.type).removeprefix("TYPE_").lower()
