"""Recordings become compliance, decay, modes, figures and verdicts."""

# A command that is interrupted while it is imported has nothing to say, and least of all a traceback.
try:
    from rig.interruption import restore_default_interrupt

    restore_default_interrupt()
except KeyboardInterrupt:
    raise SystemExit(130) from None

import lazy_loader

# A module is imported when one of the names of `__init__.pyi` is first used, so that importing the package stays
# quick: numba alone takes longer to import than a whole impulse test takes to run.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
