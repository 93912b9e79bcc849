"""Analysis of recordings: frequency responses, free decays, modes, damper motion, fits of scenes, reports."""

# A command that is interrupted during its imports exits without a traceback.
try:
    from rig.core.base.interruption import restore_default_interrupt

    restore_default_interrupt()
except KeyboardInterrupt:
    raise SystemExit(130) from None

import lazy_loader

# Each module is imported when one of its names in `__init__.pyi` is first used, because the import of all modules takes
# longer than the analysis of a short test.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
