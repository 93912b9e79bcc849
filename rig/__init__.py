"""Simulation of the rig: a scene file is compiled to a hybrid linear system, whose motion is propagated exactly."""

# An interrupt during import must end the command without a traceback.
try:
    from rig.core.base.interruption import restore_default_interrupt

    restore_default_interrupt()
except KeyboardInterrupt:
    raise SystemExit(130) from None

import lazy_loader

# A module is imported when a name of `__init__.pyi` is first used, so the package loads quickly: the import of
# numba alone takes longer than a whole impact test.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
