"""Responses of single stretches, by a model that holds near each line: the fit resolves what a window would smear.

It knows spectra and what sensors add to them, and nothing of the test they are of. Start with `local_spectra`, whose
fit is `local_rational`.
"""
