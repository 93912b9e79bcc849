"""The physics: a scene becomes a hybrid linear system, the system becomes motion."""

import lazy_loader

# A module is imported when one of the names of `__init__.pyi` is first used, so that importing the package stays
# quick: numba alone takes longer to import than a whole impulse test takes to run.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
