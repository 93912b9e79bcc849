"""Signal chain from motion to volts at the converter: sensor, amplifier, coupling, sampling, quantisation.

This room does not depend on tests or files. Start with `chain`; `devices` turns data sheets into stages.
"""
