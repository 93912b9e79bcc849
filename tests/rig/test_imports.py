"""Imports that a command does without."""

import subprocess
import sys

CODE = """
import sys
import rig.core.base.arrays
from scipy.linalg import expm
print({"numpy.f2py.crackfortran", "numpy.testing._private.utils"} & set(sys.modules))
from numpy.testing import assert_array_equal
print("numpy.testing._private.utils" in sys.modules)
"""


def test_scipy_imports_no_unused_parts_of_numpy() -> None:
    output = subprocess.run([sys.executable, "-c", CODE], check=True, capture_output=True, text=True).stdout
    assert output.split() == ["set()", "True"]
