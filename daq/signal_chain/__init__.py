"""Signal chain from motion to volts at the converter: sensor, amplifier, coupling, sampling, quantization.

This room does not depend on tests or files. Start with `chain`; `devices` turns data sheets into stages.
"""
