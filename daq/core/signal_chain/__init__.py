"""Simulates the signal chain from motion to counts: sensor, amplifier, coupling, sampling, quantization.

Start with `chain`; `devices` converts data sheets into stages, the devices of a channel in series. The package depends
neither on tests of a scene nor on files.
"""
