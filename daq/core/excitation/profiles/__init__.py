"""Control of a profile: amplitudes along a sweep, a density along frequency, or a pulse along time.

The drive is computed from an identified response and corrected from measured deviations. Start with `spectrum_shaping`,
for a flat force spectrum; `identification` and `pretest` measure the responses.
"""
