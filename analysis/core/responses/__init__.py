"""Estimation of frequency responses from recordings, with one estimator for each kind of test.

Start with `frequency_responses`, which chooses the estimator. Each estimator is named after its test. `local_models`
fits spectra, `checks` detects faults of channels, and `errors` computes the uncertainty.
"""
