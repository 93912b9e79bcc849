"""A checksum for the fields of metadata records, which have none in MCAP."""

from __future__ import annotations

from collections.abc import Mapping


def checked(fields: Mapping[str, str]) -> dict[str, str]:
    """Add a checksum to the fields of a metadata record.

    >>> is_intact(checked({"rate": "5120"})), is_intact(checked({"rate": "5120"}) | {"rate": "5121"})
    (True, False)
    """
    return {**fields, "crc32": _checksum(fields)}


def is_intact(fields: Mapping[str, str]) -> bool:
    """Whether a metadata record agrees with its checksum."""
    rest = {key: value for key, value in fields.items() if key != "crc32"}
    return fields.get("crc32") == _checksum(rest)


def _checksum(fields: Mapping[str, str]) -> str:
    import zlib

    text = "".join(f"{key}\0{fields[key]}\0" for key in sorted(fields))
    return f"{zlib.crc32(text.encode()):08x}"
