"""Types of numpy arrays, real and complex."""

import lazy_loader
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# scipy copies every name in numpy, also the names of these packages, which would import them. This would take as long
# as all imports of scipy itself. They are therefore imported at their first use.
for _package in ("ctypeslib", "f2py", "ma", "testing"):
    setattr(np, _package, lazy_loader.load(f"numpy.{_package}", suppress_warning=True))
