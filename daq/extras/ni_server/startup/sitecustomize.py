"""Startup code of Python in a process of `daq run`: Python imports the first module `sitecustomize` on its path.

This folder, which is not a package, is the first on the path. The next module of this name on the path is then executed
too.
"""

import importlib.machinery
import importlib.util
import os
import sys
from pathlib import Path

if "SHOTRIG_SERVER" in os.environ:
    from daq.extras.ni_server.client_defaults import prepare

    prepare()

_here = str(Path(__file__).resolve().parent)
_spec = importlib.machinery.PathFinder.find_spec(
    "sitecustomize", [folder for folder in sys.path if str(Path(folder).resolve()) != _here]
)
if _spec is not None and _spec.loader is not None:
    _spec.loader.exec_module(importlib.util.module_from_spec(_spec))
