"""Files, worker processes, errors and text, independent of scenes and motion."""
