"""Control of one tone, steady or slowly swept: of its amplitude, its complex envelope, or its phase.

Start with `steady_tone`. `settling` detects the steady state, and `nearest_mode` identifies the mode nearest to the
tone, from which other controllers predict the response.
"""
