"""Simulates the signal chain from motion to counts: sensor, amplifier, coupling, sampling, quantization.

Start with `chain`; `devices` turns data sheets into stages. The package depends neither on tests of a scene nor on
files.
"""
