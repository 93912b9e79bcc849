"""Types of numpy arrays, real and complex."""

import lazy_loader
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# scipy copies every name in numpy, also the names of these packages. Their import would take as long as all that scipy
# itself imports, and they are not used; they are imported at their first use.
for _package in ("f2py", "testing"):
    setattr(np, _package, lazy_loader.load(f"numpy.{_package}", suppress_warning=True))
