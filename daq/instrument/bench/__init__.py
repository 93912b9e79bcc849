"""What stands behind the chassis: a scene's bench as a source of samples that takes drives."""
