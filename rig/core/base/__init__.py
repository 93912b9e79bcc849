"""Files, worker processes, errors and text: they know no rig."""
