"""The virtual bench: converts the drive of the rig into samples of its channels at one or several rates."""
