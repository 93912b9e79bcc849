"""Store the machine code of compiled functions on disk, with a checksum, one file for each signature.

The cache of numba itself has no checksums: a truncated file ends the program, and a flipped bit is executed.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from typing import Any

from numba.core.caching import CompileResultCacheImpl
from numba.core.serialize import dumps

from rig.core.base.console import warn_of_compilation
from rig.core.base.ending_signals import delayed_interrupt

_CHECKSUM_BYTES = 4


class CodeCache:
    """The stored machine code of a function, with the interface of the cache of numba's dispatchers.

    `refreshes`: whether numba's registries must be refreshed before code is loaded.
    """

    def __init__(self, function: Callable[..., object], refreshes: bool) -> None:
        self._format, self._refreshes = CompileResultCacheImpl(function), refreshes
        self.cache_path = self._format.locator.get_cache_path()
        closure = tuple(cell.cell_contents for cell in function.__closure__ or ())
        self._closure_digest = hashlib.sha256(dumps(closure)).hexdigest()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled function for a signature; None if there is no intact machine code."""
        if self._refreshes:
            target.refresh()
        path = self._path(signature, target.codegen())
        try:
            stored = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            warn_of_compilation(
                f"machine code in {path.parent} cannot be read ({error.strerror}), and is compiled again"
            )
            return None
        code = stored[_CHECKSUM_BYTES:]
        if stored[:_CHECKSUM_BYTES] != _checksum(path, code):
            warn_of_compilation(f"machine code in {path.parent} is damaged, and is compiled again")
            return None
        # LLVM loads code in a callback. An interrupt there is lost together with the code, and the next call would
        # crash.
        with delayed_interrupt():
            return self._format.rebuild(target, pickle.loads(code))

    def save_overload(self, signature: Any, result: Any) -> None:
        """Store a compiled function; if the disk is full, only log this."""
        if not self._format.check_cachable(result):
            return
        code = dumps(self._format.reduce(result))
        path = self._path(signature, result.codegen)
        temporary = path.with_name(f"{path.name}.{token_hex(6)}")
        try:
            temporary.write_bytes(_checksum(path, code) + code)
            temporary.replace(path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            warn_of_compilation(
                f"machine code cannot be stored in {path.parent} ({error.strerror}), so every start compiles it again. "
                "Free disk space, or set the environment variable NUMBA_CACHE_DIR to another folder."
            )

    def _path(self, signature: Any, codegen: Any) -> Path:
        """Return the file for a signature and a processor."""
        key = repr((signature, codegen.magic_tuple(), self._closure_digest))
        digest = hashlib.sha256(os.fsencode(key)).hexdigest()[:16]
        return Path(self.cache_path) / f"{self._format.filename_base}.{digest}.code"


def _checksum(path: Path, code: bytes) -> bytes:
    """Return the checksum of machine code and the name of its file."""
    return zlib.crc32(code, zlib.crc32(os.fsencode(path.name))).to_bytes(_CHECKSUM_BYTES, "little")
