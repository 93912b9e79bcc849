"""Programs and tests of other authors with the pytest plugin, unchanged; run by hand.

* NI's examples: `python -m tests.plugin_suites.ni_examples CHECKOUT`, with https://github.com/ni/nidaqmx-python.
* The tests of nidaqwrapper, with https://github.com/ladisk/nidaqwrapper and pyTrigger, in its folder, with this
  project installed:

      pytest --nidaqmx --nidaqmx-bench=PATH/nidaqwrapper-hardware.yaml -m hardware
      pytest --nidaqmx --nidaqmx-bench=PATH/nidaqwrapper-simulated.yaml -m simulated
"""
