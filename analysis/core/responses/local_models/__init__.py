"""Responses from the spectra of segments, by a local model around each frequency, without the leakage of a window.

The package uses spectra and the transfer functions of the sensors; it does not depend on the kind of test. Start with
`local_spectra`; its fit is in `local_rational`.
"""
