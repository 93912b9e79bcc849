"""The instrument: sensors, converter, clock, tasks, recorder, replay."""

# A command that is interrupted during its import ends without a traceback.
try:
    from rig.core.base.interruption import restore_default_interrupt

    restore_default_interrupt()
except KeyboardInterrupt:
    raise SystemExit(130) from None

import lazy_loader

# A module is imported when one of the names of `__init__.pyi` is first used, which keeps the import of the package
# fast: the import of numba alone takes longer than an impact test.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
