"""Control of one tone, steady or slow: its amplitude, its complex envelope, or its phase by the frequency.

Start with `steady_tone`. `lock_in` estimates amplitudes, `settling` detects the steady state, and `nearest_mode`
identifies the mode from whose response the other controllers predict.
"""
