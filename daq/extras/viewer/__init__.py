"""Recordings described in words, and shown in the rerun viewer, in a window, file or picture.

The motion is that of the recording; nothing is simulated again. Start with `show` and `description`; `viewer_stream`
sends channels and motion, `outputs` opens the window or writes the file, `rerun_viewer` starts the viewer.
"""
