"""A recording in the rerun viewer: moving rig, traces, markers; to a window, a file or a picture.

The motion shown is that of the recording; nothing is simulated again. Start with `replay`; `viewer_stream`
sends channels and motion, `outputs` opens the window or writes the file, `rerun_viewer` starts the viewer.
"""
