"""From motion to samples: sensor, amplifier, converter, and the bench that holds them all beside the rig.

Nothing here knows tests or files. Start with `bench`; `sensors`, `amplifier` and `converter` turn data sheets into
stages, and `chain` carries all channels.
"""
